"""Benchmark `control`: scripted, learned and random policies on every task."""
