"""Plausibility of a recording: what it holds in numbers, and which of them cannot be right."""
