"""Put the scenes, which are beside the package, into it; pyproject.toml has everything else."""

from setuptools import find_namespace_packages, setup

SCENES = ["surgisoft.scenes.phantom_liver", "surgisoft.scenes.phantom_liver.experiments"]

setup(
    packages=[*find_namespace_packages(include=["surgisoft", "surgisoft.*"]), *SCENES],
    package_dir={"surgisoft.scenes": "scenes"},
)
