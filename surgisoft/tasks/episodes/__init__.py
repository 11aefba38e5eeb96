"""Episodes: their log, its parts, and the file that keeps it."""
