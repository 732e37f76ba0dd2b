"""Measured data of other formats becomes recordings."""
