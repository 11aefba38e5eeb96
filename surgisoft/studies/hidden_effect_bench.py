"""A rig with something hidden in it, and the recordings that are made on it, kept in a folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from surgisoft.diagnosis.experiments import AS_IT_STANDS, SETTINGS
from surgisoft.measurement.protocols import Protocol, make_protocol
from surgisoft.measurement.recording import Recording, load_recording, save_recording
from surgisoft.measurement.rig import VirtualRig
from surgisoft.measurement.rig.virtual import MOUNT
from surgisoft.studies.kept import Kept, Report


def _silent(done: float, total: float, note: str = "") -> None:
    pass


@dataclass(frozen=True)
class Bench:
    """One arm with what is hidden in it."""

    kept: Kept
    """Where recordings are kept."""
    specimen: int
    """Seed of the arm's casting."""
    hidden: tuple[tuple[str, float], ...]
    """Hidden effects and their strengths."""
    samples: int
    """Samples of a `mixed` recording, at 20 Hz."""

    @property
    def about(self) -> dict:
        """What a result of this bench depends on."""
        hidden = [list(pair) for pair in self.hidden]
        return {"specimen": self.specimen, "hidden": hidden, "samples": self.samples}

    def mixed(self, take: int, report: Report = _silent) -> Recording:
        """A recording of the `mixed` protocol; another take draws another schedule and noise."""
        limits = VirtualRig(self.specimen).limits
        protocol = make_protocol("mixed", limits, self.samples, seed=take)
        return self.record(protocol, take, report=report)

    def record(
        self, protocol: Protocol, take: int, setting: str = AS_IT_STANDS, report: Report = _silent
    ) -> Recording:
        """A recording of a protocol on the bench as it stands, or after a change of it."""
        about = {**self.about, "take": take, "setting": setting, "protocol": protocol.name}
        about["commands"] = protocol.commands.tolist()
        file = Path(f"{self.kept.place(f'recordings/{protocol.name}', about)}.parquet")
        if not file.is_file():
            change = SETTINGS[setting]
            rig = VirtualRig(
                self.specimen,
                gravity=tuple(-x for x in MOUNT) if change.flipped else MOUNT,
                roll_deg=change.roll_deg,
                payload_g=change.payload_g,
                take=take,
                hidden=self.hidden,
            )
            recording, _ = rig.record(protocol, lambda done, total: report(done, total, "rig"))
            save_recording(recording, file)
        return load_recording(file)
