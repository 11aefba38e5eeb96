"""Who acts in tasks: drivers, training, and how well they do."""
