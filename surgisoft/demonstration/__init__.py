"""A demonstration in five steps: cut, measurement, error, its cause, and the corrected model."""

from surgisoft.demonstration.story import Demonstration, demo

__all__ = ["Demonstration", "demo"]
