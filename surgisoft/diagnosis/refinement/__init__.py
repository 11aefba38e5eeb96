"""All parameters of an amended model, fitted through the whole chain."""
