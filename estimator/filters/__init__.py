"""Ways to update the belief with one observation."""
