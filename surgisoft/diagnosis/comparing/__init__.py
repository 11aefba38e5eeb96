"""What `compare` measures: errors over axes, floors and ceilings."""
