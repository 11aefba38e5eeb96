"""Models of other origin in the place of the network: callables, and files of predictions."""
