"""Evaluation, the only place where the truth is read: metrics, runs, reports, studies and benchmarks.

Imports run one way: studies and benchmark, runs, report, metrics.
"""
