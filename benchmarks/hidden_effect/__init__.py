"""Benchmark `hidden-effect`: diagnose, amend and retrain on a rig that hides an effect."""
