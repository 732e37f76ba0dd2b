"""The tissue in MuJoCo: the compiled model, springs and welds, the jaws, and the simulation."""
