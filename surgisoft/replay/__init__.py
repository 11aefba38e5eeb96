"""Pictures and recordings for the eye: the only part that draws."""
