"""The schedule that tells rivals apart."""
