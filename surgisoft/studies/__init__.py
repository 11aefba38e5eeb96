"""Long studies, each one command: what they print is committed under docs/results."""
