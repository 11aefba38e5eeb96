"""Import every module of commands, so that each registers itself on the app."""

# ruff: noqa: F401

from surgisoft.cli import (
    amend,
    benchmark,
    collect,
    compare,
    diagnose,
    evaluate,
    experiment,
    fit,
    import_,
    improve,
    next_experiment,
    replay,
    scene,
    train,
)
