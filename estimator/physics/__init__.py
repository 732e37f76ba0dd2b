"""The surrogate's physics: mesh, energies, equilibrium, XPBD and their linear algebra."""
