"""Recordings: their columns, files, sidecars and data-quality warnings."""
