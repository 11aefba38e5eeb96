"""The arm model that ships with the package; `assets/default_arm/SOURCE.md` says how it is made."""

from importlib.resources import as_file, files

import torch

from surgisoft.surrogate.checkpoint import load_model
from surgisoft.surrogate.model import ArmModel


def default_arm(device: str | torch.device = "cpu") -> ArmModel:
    """The default arm: three chambers in kPa, five key points, hysteresis with memory."""
    with as_file(files("surgisoft") / "assets" / "default_arm") as folder:
        return load_model(folder, device)
