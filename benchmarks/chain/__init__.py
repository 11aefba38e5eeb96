"""A third generator of robots: an overdamped chain of rigid links under weight and pressure."""
