"""Reference trajectories of the tasks, batched."""
