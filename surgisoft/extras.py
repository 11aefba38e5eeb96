"""Libraries of the optional parts, and what to install where one is missing.

`pip install surgisoft` brings the core: arm models, recordings, the rig, diagnosis. Scenes,
training and replays need more libraries, which the extras of the package install.
"""

EXTRA_OF = {
    "embreex": "scene",
    "fcl": "scene",
    "rtree": "scene",
    "trimesh": "scene",
    "gymnasium": "train",
    "onnx": "train",
    "onnxscript": "train",
    "pettingzoo": "train",
    "rsl_rl": "train",
    "tensorboard": "train",
    "tensordict": "train",
    "rerun": "replay",
    "rerun_cli": "replay",
    "elastica": "elastica",
    "serial": "serial",
    "distributed": "cluster",
    "ezc3d": "lab",
    "h5py": "lab",
    "mcap": "mcap",
    "mcap_ros2": "mcap",
    "nibabel": "segmentation",
    "nrrd": "segmentation",
    "skimage": "segmentation",
}
"""The extra that installs a module, by the module's name."""


EXTRA_OF_USE = {
    "train": "train",
    "evaluate": "train",
    "export": "train",
    "make": "train",
    "batched_env": "scene",
    "parallel_env": "train",
    "experiment": "all",
    "demo": "all",
}
"""The extra that a command or function needs in whole, by its name."""
WITH_SCENE = ("train", "replay", "segmentation")
"""Extras that install the extra `scene`, too."""


def missing_library(error: ModuleNotFoundError, use: str = "") -> str | None:
    """Advice what to install for a missing module, in one line; None where no extra has it.

    use: the command or function that needs it.
    """
    name = (error.name or "").partition(".")[0]
    if name not in EXTRA_OF:
        return None
    own = EXTRA_OF[name]
    extra = EXTRA_OF_USE.get(use, own)
    if extra not in ("all", own) and not (own == "scene" and extra in WITH_SCENE):
        extra = f"{extra},{own}"
    return f"the package '{name}' is missing; install it with: pip install 'surgisoft[{extra}]'"
