"""Import every module of commands, so that each registers itself on the app."""

# ruff: noqa: F401

from surgisoft.cli import (
    benchmark,
    collect,
    compare,
    diagnose,
    evaluate,
    fit,
    import_,
    next_experiment,
    replay,
    scene,
    train,
)
