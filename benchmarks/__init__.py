"""Benchmarks: studies whose results are stored under docs/results, and timings."""
