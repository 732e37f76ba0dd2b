"""Whole jobs: a scene or a recording to results and a report."""
