"""Benchmark `real`: known changes of real robots, one TOML file each, and what `diagnose` answers.

The recordings are no part of the project; the command reads the user's own copy of them.
"""
