"""Protocols: commanded pressures over time, and when samples are recorded."""

from surgisoft.measurement.protocols.catalogue import PROTOCOLS, Entry, make_protocol
from surgisoft.measurement.protocols.continuous import SIGNALS, Knots, Signal
from surgisoft.measurement.protocols.protocol import Protocol
from surgisoft.measurement.protocols.schedule_file import load_schedule

__all__ = [
    "PROTOCOLS",
    "SIGNALS",
    "Entry",
    "Knots",
    "Protocol",
    "Signal",
    "load_schedule",
    "make_protocol",
]
