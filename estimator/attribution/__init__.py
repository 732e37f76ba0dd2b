"""Attribution: from the unexplained residual of a fit to the effect that the model lacks."""
