"""Figures of an estimate against the truth."""
