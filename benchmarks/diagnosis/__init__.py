"""Benchmark `diagnosis`: missing effects named on simulated robots."""
