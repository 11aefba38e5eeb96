"""Conversion of raw laboratory files into recordings."""
