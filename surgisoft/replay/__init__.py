"""Replays of episodes, scenes and comparisons in the Rerun viewer; the only part that draws."""
