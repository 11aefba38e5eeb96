"""Worlds, tasks, and adapters that hand them to PettingZoo and Gymnasium."""
