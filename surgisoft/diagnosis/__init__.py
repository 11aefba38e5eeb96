"""Models against recordings."""
