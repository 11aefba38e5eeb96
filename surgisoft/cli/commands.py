"""Import every module of commands, so that each registers itself on the app."""
