"""From what a fit leaves over to the effect that the model lacks."""
