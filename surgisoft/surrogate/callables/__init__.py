"""Models of other origin in the place of the network: Python callables, and files of predictions."""
