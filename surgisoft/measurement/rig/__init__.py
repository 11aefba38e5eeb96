"""The virtual rig, and what it has in common with a bench: command pressures, read samples."""

from surgisoft.measurement.rig.collect import collect
from surgisoft.measurement.rig.interface import Rig, Sample
from surgisoft.measurement.rig.virtual import Truth, VirtualRig

__all__ = ["Rig", "Sample", "Truth", "VirtualRig", "collect"]
