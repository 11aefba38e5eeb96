"""Settings that hold for every test: one thread, seeds, and where measured data may lie."""

import os
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "surgisoft", deadline=None, max_examples=30, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("surgisoft")


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    import torch

    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of public recordings and meshes that are no part of the project."""
    beside = Path(__file__).resolve().parents[2] / "shared"
    folder = Path(os.environ.get("SURGISOFT_SHARED", beside))
    if not folder.is_dir():
        pytest.skip("public recordings and meshes are not here (set SURGISOFT_SHARED)")
    return folder
