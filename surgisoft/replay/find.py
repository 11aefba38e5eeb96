"""Which recording a path means."""

from pathlib import Path

import pyarrow.compute as pc

from surgisoft.errors import InputError
from surgisoft.replay.recording import SUFFIX, TIME

PLACES = (f"*{SUFFIX}", f"replays/*{SUFFIX}", "replays/*.npz")
"""Where a run's folder keeps its replays."""
MAGIC = b"RRF2"
"""First bytes of a Rerun recording, as rerun-sdk 0.41 writes it."""


def find_replay(path: str | Path) -> Path:
    """The replay (.rrd) or episode's log (.npz) itself, or the newest replay of a run's folder."""
    path = Path(path)
    if path.is_dir():
        replays = [file for place in PLACES for file in path.glob(place) if file.is_file()]
        if not replays:
            raise InputError(
                f"{path}: holds no replay; expected {' or '.join(PLACES)} in it, as "
                "'surgisoft train' writes them"
            )
        return max(replays, key=lambda file: (file.stat().st_mtime_ns, file.name))
    if not path.is_file():
        raise InputError(f"{path}: there is no such file or folder; expected a replay or a run")
    if path.suffix not in (SUFFIX, ".npz"):
        raise InputError(
            f"{path}: suffix '{path.suffix}', expected a replay ({SUFFIX}), an episode's log "
            "(.npz) or a run's folder"
        )
    if path.suffix == SUFFIX:
        with path.open("rb") as file:
            start = file.read(len(MAGIC))
        if start != MAGIC:
            raise InputError(f"{path}: is no Rerun recording; expected one as 'replay' writes it")
    return path


def moment(recording: Path, time_s: float | None) -> tuple[str, float] | None:
    """Timeline and time for a picture; without a time two thirds through.

    None for a recording without a timeline of seconds, such as a scene's.
    """
    end = duration_s(recording)
    if end is None:
        if time_s is not None:
            raise InputError(f"{recording}: has no timeline '{TIME}', so --time says nothing")
        return None
    if time_s is not None and not 0.0 <= time_s <= end + 1e-6:
        raise InputError(f"time is {time_s:g} s, expected 0 to {end:g} s as {recording} lasts")
    return TIME, float(end * 2.0 / 3.0 if time_s is None else time_s)


def duration_s(recording: Path) -> float | None:
    """How long a replay lasts on its timeline of seconds; None where it has none."""
    from rerun.chunk import RrdReader

    ends = []
    try:
        for chunk in RrdReader(recording).stream():
            if TIME in chunk.timeline_names and chunk.num_rows:
                ends.append(pc.max(chunk.to_record_batch().column(TIME).cast("int64")).as_py())
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{recording}: cannot be read as a Rerun recording ({error})") from None
    return max(ends) * 1e-9 if ends else None
