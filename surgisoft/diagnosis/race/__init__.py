"""Effects compete to explain held-out errors."""
