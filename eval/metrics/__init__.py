"""Metrics: figures of an estimate against the truth, and the file that holds them."""
