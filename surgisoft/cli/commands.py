"""Import every module of commands, so that each registers itself on the app."""

from surgisoft.cli import benchmark, collect, compare, diagnose, fit, import_, replay, scene, train  # noqa: F401
