"""Fit and report of the decision of a diagnosis: cases of several sources, one left out in turn."""
