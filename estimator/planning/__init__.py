"""Policies: who chooses the next action."""
