"""A demonstration in five steps: the cut, the measurement, the error, its cause, the mended model."""

from surgisoft.demo.story import Demonstration, demo

__all__ = ["Demonstration", "demo"]
