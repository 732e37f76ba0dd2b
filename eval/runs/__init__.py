"""Runs: complete jobs from a scene or a recording to results and a report."""
