"""Logs of episodes: what they hold, how they are recorded, and their file format."""
