"""Benchmarks: the time of the estimator's parts and of the reference tissue."""
