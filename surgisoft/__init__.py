"""Multi-agent surgical scenarios for soft robots, with arm models judged by measurements."""

__version__ = "0.1.0"
