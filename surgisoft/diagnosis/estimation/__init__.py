"""Estimation: the parameters of effects in a model, fitted through the whole chain."""
