"""Entries of the benchmark: a TOML file for each known change of a real robot."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from surgisoft.config import Rule, Where, at_least, from_table, one_of, read_toml
from surgisoft.diagnosis.setup.search import KINDS
from surgisoft.errors import InputError, unknown_name
from surgisoft.measurement.histories import ACTUATIONS
from surgisoft.measurement.importing import import_files, load_map
from surgisoft.measurement.recordings import Recording, load_recordings
from surgisoft.surrogate.effects import known_effects
from surgisoft.surrogate.fit import PRIORS, FitConfig

FOLDER = Path(__file__).parent
"""The entries of the project."""
VARIABLE = "SURGISOFT_REAL_DATA"
"""Environment variable with the folder of the recordings."""
UNKNOWN = "unknown"
"""Truth of a change that no effect of the catalogue describes."""
SETUP = "setup"
"""Truth of a change of the cameras' frame, the units, the order of the chambers or the clock."""
FAULTS = (*KINDS, "dead_chamber", "dead_key_point")
"""Kinds of faults of the set-up."""
READY = (".csv", ".parquet")
"""Suffixes of recordings that need no map."""

NOT_EMPTY = Rule("text", lambda value: bool(value.strip()))


@dataclass(frozen=True)
class Source:
    """Table [before] or [after]: where recordings come from."""

    files: Annotated[tuple[str, ...], Rule("at least one file", lambda value: len(value) > 0)]
    """Files below the folder of the user's data; `*` matches as in a shell."""
    map: str = ""
    """Map of `surgisoft import`, relative to the entry's file; empty: ready recordings."""
    part: tuple[float, float] = (0.0, 1.0)
    """Share of the recording's rows at which the part that counts begins and ends."""

    def checked(self, where: Where) -> "Source":
        """The table itself; raises InputError for a part that is empty."""
        for number, file in enumerate(self.files):
            if not file or Path(file).is_absolute():
                place = where / "files" / number
                raise place.error(f"got text '{file}'", "a path relative to the data folder")
        begin, end = self.part
        if not 0.0 <= begin < end <= 1.0:
            raise (where / "part").error(
                f"got {list(self.part)}", "two shares, 0 <= begin < end <= 1"
            )
        if self.map and not (where.path.parent / self.map).is_file():
            raise (where / "map").error(
                f"no such file '{self.map}'", "a map, relative to this file"
            )
        return replace(self, map=str(where.path.parent / self.map) if self.map else "")


@dataclass(frozen=True)
class FitOptions:
    """Table [fit]: options of `surgisoft fit`, where they are not its defaults."""

    inputs: Annotated[str, one_of(("pressure", "pressure+direction"))] = FitConfig.inputs
    """Inputs of the network for each chamber."""
    effects: tuple[str, ...] = ()
    """Effects that the model is fitted with; `auto` lets held-out data choose."""
    prior: Annotated[str, one_of(PRIORS)] | None = None
    """Prior mean of the network; None: that of `surgisoft fit`."""
    widths: Annotated[
        tuple[Annotated[int, at_least(1)], ...],
        Rule("at least one width", lambda value: len(value) > 0),
    ] = FitConfig.hidden
    """Widths of the hidden layers."""
    epochs: Annotated[int, at_least(1)] = FitConfig.epochs
    """Largest number of epochs of a stage."""
    seed: Annotated[int, at_least(0)] = 0
    """Seed of weights, order of rows and held-out blocks."""


@dataclass(frozen=True)
class Entry:
    """One known change of a real robot, or one question about a real robot."""

    robot: Annotated[str, NOT_EMPTY]
    """The robot and its maker."""
    change: Annotated[str, NOT_EMPTY]
    """The change in words."""
    truth: tuple[str, ...]
    """The effects that the change consists of; `unknown`, `setup`, or none: nothing changed."""
    source: Annotated[str, NOT_EMPTY]
    """Where the recordings come from."""
    licence: Annotated[str, NOT_EMPTY]
    """Licence of the recordings."""
    before: Source
    """Recordings that the model is fitted to."""
    after: Source | None = None
    """Recordings after the change; absent: what does the model lack on its own recordings?"""
    actuation: Annotated[str, one_of(ACTUATIONS)] = "measured"
    """Which actuation is the model's input."""
    fit: FitOptions = field(default_factory=FitOptions)
    """How the model is fitted."""
    faults: tuple[Annotated[str, one_of(FAULTS)], ...] = ()
    """For the truth `setup`: the kinds of faults, all of which and no other are to be found."""
    note: str = ""
    """What else is known: how sure the truth is, and what else differs."""
    name: str = ""
    """Name of the entry: the stem of its file."""

    def checked(self, where: Where) -> "Entry":
        """The entry with its file's stem as name; raises InputError for an unknown truth."""
        known = (*known_effects(), UNKNOWN, SETUP)
        for number, name in enumerate(self.truth):
            if name not in known:
                place = where / "truth" / number
                raise place.error(f"got text '{name}'", f"one of {', '.join(known)}")
        if {UNKNOWN, SETUP}.intersection(self.truth) and len(self.truth) > 1:
            raise (where / "truth").error(
                f"got {list(self.truth)}", f"'{UNKNOWN}' or '{SETUP}' alone, or names of effects"
            )
        if bool(self.faults) != (self.truth == (SETUP,)):
            raise (where / "faults").error(
                f"got {list(self.faults)} for the truth {list(self.truth)}",
                f"kinds of faults where the truth is '{SETUP}', and none elsewhere",
            )
        return replace(self, name=where.path.stem)


def load_entry(path: Path) -> Entry:
    """One entry; raises InputError in one line for a bad file."""
    return from_table(Entry, *read_toml(path))


def load_entries(paths: Sequence[Path], only: str | None = None) -> list[Entry]:
    """The entries of files and folders, by default those of the project, in order of their names.

    only: name of the one entry to keep.
    """
    files: list[Path] = []
    for path in paths or [FOLDER]:
        if path.is_dir():
            inside = sorted(path.glob("*.toml"))
            if not inside:
                raise InputError(f"{path}: no .toml in this folder, expected entries of `real`")
            files += inside
        else:
            files.append(path)
    if only is not None:
        names = [file.stem for file in files]
        if only not in names:
            raise unknown_name("entry", only, names)
        files = [file for file in files if file.stem == only]
    return [load_entry(file) for file in files]


def data_folder(given: Path | None) -> Path:
    """The folder of the user's recordings: as given, or as the environment names it."""
    text = os.environ.get(VARIABLE, "") if given is None else str(given)
    if not text:
        raise InputError(
            f"no folder of recordings: give --data FOLDER or set {VARIABLE}; "
            "docs/real_data.md says where the recordings come from"
        )
    if not Path(text).is_dir():
        raise InputError(f"{text}: no such folder, expected the folder of the recordings")
    return Path(text)


def files_of(source: Source, data: Path) -> list[Path]:
    """The files of a source; raises InputError that names the first absent one."""
    found: list[Path] = []
    for pattern in source.files:
        try:
            matches = sorted(data.glob(pattern))
        except ValueError as error:
            raise InputError(f"{pattern}: not a pattern of files ({error})") from None
        if not matches:
            raise InputError(f"{pattern}: no such file in {data}, expected the entry's recordings")
        found += matches
    return list(dict.fromkeys(found))


def recordings_of(source: Source, data: Path, name: str) -> list[Recording]:
    """The recordings of a source, imported by its map, cut to the part that counts."""
    files = files_of(source, data)
    if source.map:
        whole = [part.recording for part in import_files(files, load_map(source.map), name)]
    else:
        strange = [file for file in files if file.suffix not in READY]
        if strange:
            raise InputError(
                f"{strange[0]}: not a recording ({' or '.join(READY)}); name a map in the entry"
            )
        whole = load_recordings(files, lambda text: None)
    return [part_of(recording, *source.part) for recording in whole]


def part_of(recording: Recording, begin: float, end: float) -> Recording:
    """The rows of a recording between two shares of their number."""
    if (begin, end) == (0.0, 1.0):
        return recording
    rows = slice(round(begin * recording.samples), round(end * recording.samples))
    if rows.stop <= rows.start:
        raise InputError(
            f"{recording.label}: no row between the shares {begin:g} and {end:g} of "
            f"{recording.samples} rows"
        )
    by_row = ("t_s", "measured", "key_points_mm", "commanded", "run", "temp_C", "payload_g")
    cut = {
        field: getattr(recording, field)[rows]
        for field in by_row
        if getattr(recording, field) is not None
    }
    return replace(recording, **cut)
