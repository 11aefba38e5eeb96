"""Diagnosis: where an arm model fails on recordings, and which physical effect it lacks."""
