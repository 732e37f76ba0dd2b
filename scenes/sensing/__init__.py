"""Observations of the simulation: stereo images, measured points and the tool's reports."""
