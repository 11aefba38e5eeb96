"""Benchmarks: studies whose printed results are kept under docs/results, and timings."""
