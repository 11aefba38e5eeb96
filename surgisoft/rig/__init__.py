"""The virtual rig, and what it has in common with a bench: command pressures, read samples."""

from surgisoft.rig.collect import collect
from surgisoft.rig.interface import Rig, Sample
from surgisoft.rig.virtual import Truth, VirtualRig

__all__ = ["Rig", "Sample", "Truth", "VirtualRig", "collect"]
