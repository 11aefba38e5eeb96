"""The line protocol between a computer and a pressure controller, version 1.

Text in ASCII over a serial line, 8N1, one message a line:

    >BODY*CRC\\n    from the computer        <BODY*CRC\\n    from the controller

BODY is words separated by single spaces; CRC is the CRC-16/CCITT-FALSE of BODY (polynomial 0x1021,
initial value 0xFFFF, not reflected; "123456789" gives 29B1) as four hexadecimal digits. A line with
a wrong CRC is ignored. Pressures are gauge pressures in kPa with three decimals, times are ms of
the controller's clock.

From the computer:

    HELLO                  the controller answers INFO
    WATCH hold_ms vent_ms  set the watchdog, within the controller's own bounds; answers INFO
    SET seq p1 ... pm      set points; seq is a number that the report repeats
    VENT seq               open every valve now; the controller is idle afterwards
    ARM seq                leave the state T, after the cause was found

From the controller:

    INFO 1 m low high hold_ms vent_ms name   version 1, m chambers, limits in kPa
    DATA ms seq state p1 ... pm s1 ... sm    at a fixed rate: clock, number of the last command that
                                             was accepted, state, measured pressures, set points
    NAK seq reason                           a command was refused, and why

States: I idle, every valve vented on request; R running; H hold: no SET for hold_ms, set points are
held; T tripped: no SET for vent_ms, every valve was vented and stays so until ARM.

**The controller's watchdog is the last line of safety.** Whatever happens to the computer (kill -9,
a crash, a cut cable), no SET arrives, and after vent_ms the controller vents by itself. It clips
set points to its own limits and starts vented.
"""

from dataclasses import dataclass

VERSION = 1
"""Version of the protocol."""
STATES = {"I": "idle", "R": "running", "H": "hold", "T": "tripped"}
"""States of the controller."""
LONGEST = 512
"""Longest line [characters]."""


def crc16(body: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, initial value 0xFFFF."""
    crc = 0xFFFF
    for byte in body:
        crc ^= byte << 8
        for _ in range(8):
            crc = ((crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


def line(body: str, side: str = ">") -> bytes:
    """A message as a line; side: `>` from the computer, `<` from the controller."""
    text = body.encode("ascii")
    return side.encode() + text + b"*%04X\n" % crc16(text)


def words_of(raw: bytes, side: str) -> list[str] | None:
    """The words of a line; None where it is damaged or comes from the other side."""
    raw = raw.strip(b"\r\n \0")
    if not raw.startswith(side.encode()) or len(raw) < 6 or raw[-5:-4] != b"*":
        return None
    body = raw[1:-5]
    try:
        if crc16(body) != int(raw[-4:], 16):
            return None
        return body.decode("ascii").split(" ")
    except ValueError:
        return None


@dataclass(frozen=True)
class Info:
    """Properties that a controller states about itself."""

    chambers: int
    """Number m of chambers."""
    low_kPa: float
    """Lowest set point [kPa]."""
    high_kPa: float
    """Highest set point [kPa]."""
    hold_ms: int
    """Time without a command after which set points are held [ms]."""
    vent_ms: int
    """Time without a command after which every valve is vented [ms]."""
    name: str
    """Name of the controller."""

    def words(self) -> str:
        """The message."""
        return (
            f"INFO {VERSION} {self.chambers} {self.low_kPa:.3f} {self.high_kPa:.3f} "
            f"{self.hold_ms} {self.vent_ms} {self.name}"
        )

    @staticmethod
    def read(words: list[str]) -> "Info":
        """From the words of a message; raises ValueError where they are none."""
        kind, version, chambers, low, high, hold, vent, *name = words
        if kind != "INFO" or int(version) != VERSION:
            raise ValueError(f"got version {version} of {kind}, expected version {VERSION} of INFO")
        return Info(int(chambers), float(low), float(high), int(hold), int(vent), " ".join(name))


@dataclass(frozen=True)
class Data:
    """One report of a controller."""

    ms: int
    """Clock of the controller [ms]."""
    seq: int
    """Number of the last command that was accepted."""
    state: str
    """One of `STATES`."""
    measured: tuple[float, ...]
    """(m,) measured pressures [kPa]; NaN where a sensor is silent."""
    target: tuple[float, ...]
    """(m,) set points [kPa]."""

    def words(self) -> str:
        """The message."""
        numbers = " ".join(f"{x:.3f}" for x in (*self.measured, *self.target))
        return f"DATA {self.ms} {self.seq} {self.state} {numbers}"

    @staticmethod
    def read(words: list[str], chambers: int) -> "Data":
        """From the words of a message; raises ValueError where they are none."""
        kind, ms, seq, state, *numbers = words
        if kind != "DATA" or state not in STATES or len(numbers) != 2 * chambers:
            raise ValueError(f"no report of {chambers} chambers: {' '.join(words)}")
        values = tuple(map(float, numbers))
        return Data(int(ms), int(seq), state, values[:chambers], values[chambers:])
