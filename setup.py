"""Puts the scenes that stand beside the package into it; all else is said in pyproject.toml."""

from setuptools import find_namespace_packages, setup

PHANTOM = "surgisoft.scenes.phantom_liver"

setup(
    packages=[*find_namespace_packages(include=["surgisoft", "surgisoft.*"]), PHANTOM],
    package_dir={"surgisoft.scenes": "scenes"},
)
