"""Record results of the command line, and compare two such records number by number.

    python benchmarks/answers.py record --out before            # with the code as it is
    python benchmarks/answers.py record --out after --inputs before/inputs    # after a change
    python benchmarks/answers.py compare before after           # exit code 1 where they differ

`record` starts `python -m surgisoft.cli ...` in the current folder, one process at a time, with
fixed seeds, and writes one JSON file per item into the folder `--out`. The current folder must be
the root of the tree that is to be asked: Python takes the package from there. An item whose JSON
file stands is skipped, a command that has ended is not started again (its output stays in
`OUT/raw`), so that an interrupted record goes on where it was. `OUT/about.json` holds a hash of
the package's source; a folder that other code recorded is refused.

Recordings, fitted models and training runs that several items read are made once in `OUT/inputs`.
`--inputs DIR` takes those of an earlier record, so that only the code that reads them differs. If
a later version cannot read an older model or run, copy the folder of inputs and delete the model in
the copy: whatever is missing there is made by the code that is asked.

`compare` calls a number equal when all its digits are, "within" when it lies inside its tolerance
(`TOLERANCES`), and different otherwise. Words (the kind of a verdict, names of
effects, outcomes) must be the same.

Names may change between two versions. Where a program's output is read, the tables below hold for
each recorded number the names under which it is accepted (`COMPARE`, `DIAGNOSE`, ...): add the new
name behind the old one. Names that are stored as they come (effects, tasks' measures, columns,
entity paths) are translated by `SAME_NAMES` before two records are compared. After a change of
the tables delete the items' JSON files (not `OUT/raw`) and record again: nothing is run twice.

Times on the clock and on the processor are left out; they are the only results in which two runs of
the same code on the same machine differ.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

# ---------------------------------------------------------------------------------------------
# Tolerances and names
# ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tolerance:
    """How far apart two numbers of a group of items may lie."""

    relative: float
    """Share of the larger number."""
    absolute: float
    """In the unit of the number; the larger of both limits counts."""
    reason: str
    """Why that much."""
    counts: bool = False
    """Whether whole numbers may differ, too."""


ROUNDING = "single precision, another order of sums"
CHAOS = "rounding grows from step to step"

TOLERANCES: dict[str, Tolerance] = {
    "train.* first.*": Tolerance(1e-4, 1e-7, "the first turn: nothing has grown yet"),
    "train.track_circle last.*error_mm": Tolerance(0.2, 0.01, f"{CHAOS}; 5 % were seen"),
    "train.* last.iteration": Tolerance(0.0, 0.0, "a count"),
    "train.* last.steps": Tolerance(0.0, 0.0, "a count"),
    "train.* last.noise": Tolerance(1e-6, 1e-9, "a schedule"),
    "train.* last.*": Tolerance(math.inf, 0.0, f"{CHAOS}: other rounding, another policy"),
    "fit.hysteresis *": Tolerance(0.05, 0.01, f"{CHAOS} of the training; 3 % were seen"),
    "fit.*": Tolerance(1e-3, 1e-4, f"{CHAOS} of the training; 1e-4 was seen"),
    "evaluate.rig* *": Tolerance(0.1, 0.01, f"{CHAOS} of a closed loop", counts=True),
    "evaluate.ring *": Tolerance(1e-3, 1e-3, "the beam is turned on or off a step apart"),
    "evaluate.* *": Tolerance(1e-3, 2e-5, ROUNDING),
    "experiment.* rig*": Tolerance(0.1, 0.01, f"{CHAOS} of a closed loop", counts=True),
    "experiment.* *": Tolerance(1e-3, 1e-3, "the beam is turned on or off a step apart"),
    "*diagnose* before_mm": Tolerance(1e-6, 1e-9, "no fit is in it"),
    "*diagnose* floor_mm": Tolerance(1e-6, 1e-9, "no fit is in it"),
    "*diagnose* *": Tolerance(0.01, 1e-3, "fits end a little apart; p values have steps of 5e-4"),
    "compare.* *": Tolerance(1e-3, 1e-5, ROUNDING),
    "import.compare* *": Tolerance(1e-3, 1e-5, ROUNDING),
    "amend.* parameters_ci95*": Tolerance(0.05, 1e-3, "ends of a fit's interval"),
    "improve.* parameters_ci95*": Tolerance(0.05, 1e-3, "ends of a fit's interval"),
    "amend.* *": Tolerance(2e-3, 1e-5, "fits end a little apart"),
    "improve.* *": Tolerance(2e-3, 1e-5, "fits end a little apart"),
    "next_experiment.* *": Tolerance(1e-3, 1e-5, "fits end a little apart"),
    "*": Tolerance(1e-6, 1e-9, "double precision, another order of sums"),
}
"""Pattern of "item key" -> tolerance; the first that fits counts.

They were set from a second record of the same code with older instructions of the processor
(ATEN_CPU_CAPABILITY=default MKL_CBWR=COMPATIBLE ONEDNN_MAX_CPU_ISA=SSE41
OPENBLAS_CORETYPE=Nehalem), which changes the last digit of most sums and nothing else. Two records
with the same instructions are equal in all digits. An infinite tolerance is never judged.
"""

SAME_NAMES: dict[str, str] = {}
"""New name -> old name, for names that are recorded as they come, whether key or value."""

COMPARE = {
    "rmse_mm": ("rmse_mm",),
    "rmse_ci95_mm": ("rmse_ci95_mm",),
    "tip_rmse_mm": ("tip_rmse_mm",),
    "per_key_point_mm": ("per_key_point_mm",),
    "components_mm": ("components_mm",),
    "mse_mm2": ("mse_mm2",),
    "floor_mm": ("floor_mm",),
    "floor_source": ("floor_source",),
    "floors_mm": ("floors",),
    "ceiling_mm": ("ceiling_mm", "best_achievable_mm"),
    "ceiling_ci95_mm": ("ceiling_ci95_mm", "best_achievable_ci95_mm"),
    "explainable": ("explainable",),
    "axis_share": ("axes[axis].share",),
    "axis_ci95": ("axes[axis].ci95",),
    "time_shift_s": ("time_shift.seconds", "time_shift"),
    "samples": ("samples",),
    "missing": ("missing",),
    "band_axis": ("bands[].axis",),
    "band_low": ("bands[].low",),
    "band_rmse_mm": ("bands[].rmse_mm",),
    "worst_mm": ("worst[].error_mm",),
    "worst_t_s": ("worst[].t_s",),
}
"""Recorded name -> where `compare --json` has it. `a.b` goes into an object, `a[]` takes all
entries of a list, `a[name]` makes an object of the list by that field, `a.*` the only entry."""

FIT_TEST = {n: p for n, p in COMPARE.items() if not n.startswith(("axis", "band", "worst"))}
"""What is recorded of `compare --json` for a model that was just fitted."""

DIAGNOSE = {
    "kind": ("verdict.kind",),
    "effects": ("verdict.effects",),
    "before_mm": ("error_mm.before",),
    "floor_mm": ("error_mm.floor",),
    "ceiling_mm": ("error_mm.ceiling", "error_mm.best_achievable"),
    "ranking": ("ranking[].effect",),
    "confidence": ("ranking[effect].confidence",),
    "gain_alone": ("ranking[effect].gain_alone",),
    "gain_unique": ("ranking[effect].gain_unique",),
    "heldout_rmse_mm": ("ranking[effect].heldout_rmse_mm",),
    "ambiguous_with": ("ambiguous_with",),
    "axis": ("axis",),
    "statistics": ("statistics",),
}
"""Recorded name -> where `diagnose --json` has it."""

AMEND = {
    "effects": ("effects",),
    "claimed": ("claimed",),
    "network_retuned": ("network_retuned",),
    "before_mm": ("error_mm.before",),
    "after_mm": ("error_mm.after",),
    "floor_mm": ("error_mm.floor",),
    "fall_ci95_mm": ("error_mm.ci95",),
    "parameters": ("parameters[effect,name].value",),
    "parameters_ci95": ("parameters[effect,name].ci95",),
}
"""Recorded name -> where `amend --json` and `improve --json` have it."""

AMEND_ONLY = {
    "refitted": ("refitted",),
    "effects_alone_after_mm": ("error_effects_alone_mm.after",),
    "open_before_mm": ("error_open_mm.before", "error_training_mm.before"),
    "open_after_mm": ("error_open_mm.after", "error_training_mm.after"),
}

IMPROVE_ONLY = {
    "verdicts": ("rounds[].verdict",),
    "steps": ("rounds[].step",),
    "rounds_open_mm": ("rounds[].error_open_mm", "rounds[].error_training_mm"),
    "rounds_mm": ("rounds[].error_mm",),
}

NEXT_EXPERIMENT = {
    "name": ("name",),
    "minutes": ("minutes",),
    "setting": ("setting",),
    "collect_options": ("collect_options",),
    "by_hand": ("by_hand",),
    "separates": ("separates",),
    "pairs": ("pairs[].effects",),
    "before": ("pairs[].before",),
    "after": ("pairs[].after",),
}
"""Recorded name -> where `next-experiment --json` has it."""

EVALUATE = {
    "task": ("task",),
    "episodes": ("episodes",),
    "dt_s": ("dt_s",),
    "overall": ("drivers.*.overall", "policies.*.overall"),
    "per_episode": ("drivers.*.per_episode", "policies.*.per_episode"),
    "referee": ("drivers.*.referee", "policies.*.exact_checks", None),
}
"""Recorded name -> where `evaluate --json` has it; None: it may be absent, without a scene."""

MODEL_CONFIG = {
    "heldout_rmse_mm": ("validation.rmse_mm",),
    "heldout_per_key_point_mm": ("validation.per_key_point_mm",),
    "heldout_rows": ("validation.rows",),
    "low": ("arm.low",),
    "high": ("arm.high",),
    "band": ("arm.band",),
    "network": ("network.kind",),
    "directions": ("network.directions", None),
    "model_effects": ("effects",),
}
"""Recorded name -> where the fitted model's config.json has it; None: it may be absent."""

MODEL_REPORT = {
    "stage": ("stages[].name",),
    "stage_rmse_mm": ("stages[].valid_rmse_mm",),
    "stage_epochs": ("stages[].epochs",),
    "stage_kept": ("stages[].kept",),
    "simpler_rmse_mm": ("stages[].simpler_rmse_mm",),
    "contrast": ("excitation[].contrast",),
}
"""Recorded name -> where the fitted model's report.json has it."""

SCENE = {
    "body": ("bodies[].name",),
    "role": ("bodies[].role",),
    "lesion_mm": ("lesion.centre_mm",),
    "diameter_mm": ("lesion.diameter_mm",),
    "mount_mm": ("mounts[tool].position_mm",),
    "mount_direction": ("mounts[tool].direction",),
    "mount_roll_deg": ("mounts[tool].roll_deg",),
}
"""Recorded name -> where scene.toml has it."""

FILES = {
    "model config": ("config.json",),
    "model report": ("report.json",),
    "training metrics": ("metrics.jsonl",),
    "experiment episodes": ("episodes.csv",),
    "scene": ("scene.toml",),
}
"""What -> accepted file names in the folder that a command wrote."""

CLOCK = ("wall_s", "cpu_s", "turn_s")
"""Fields of the training's metrics that are times of the machine, left out."""


# ---------------------------------------------------------------------------------------------
# Taking values
# ---------------------------------------------------------------------------------------------


class Absent(Exception):
    """An expected name or file is not in a command's output."""


class Skipped(Exception):
    """An item cannot be recorded here; the reason."""


def follow(value, path: str):
    """The value at a path such as "ranking[effect].gain_alone"; KeyError where it is not."""
    if not path:
        return value
    step, _, rest = path.partition(".")
    name, bracket, fields = step.partition("[")
    if name == "*":
        if not isinstance(value, dict) or len(value) != 1:
            raise KeyError(name)
        return follow(next(iter(value.values())), rest)
    if not isinstance(value, dict):
        if value is None:
            return None
        raise KeyError(name)
    entry = value[name]
    if not bracket:
        return follow(entry, rest)
    fields = [field for field in fields.rstrip("]").split(",") if field]
    if not fields:
        return [follow(one, rest) for one in entry or ()]
    return {"/".join(str(one[field]) for field in fields): follow(one, rest) for one in entry or ()}


def take(document: dict, names: dict[str, tuple[str | None, ...]]) -> dict:
    """Recorded name -> value, by the first accepted path that the document has."""
    values = {}
    for name, paths in names.items():
        for path in paths:
            if path is None:
                values[name] = None
                break
            try:
                values[name] = follow(document, path)
                break
            except (KeyError, TypeError):
                continue
        else:
            raise Absent(f"none of {', '.join(paths)} among {', '.join(document)}")
    return values


def found(folder: Path, what: str) -> Path:
    """The file of that kind in a folder, under any of its accepted names."""
    for name in FILES[what]:
        if (folder / name).is_file():
            return folder / name
    raise Absent(f"no {what} ({', '.join(FILES[what])}) in {folder}")


def flat(value, name: str = "") -> dict:
    """Nested objects as one, names joined by dots; lists stay."""
    if not isinstance(value, dict):
        return {name: value}
    out = {}
    for key, entry in value.items():
        out.update(flat(entry, f"{name}.{key}" if name else str(key)))
    return out


def printed_numbers(text: str) -> list[float]:
    """All numbers of a text in order; digits that belong to a name (k0, p1) are left out."""
    return [float(n) for n in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)", text)]


def recording_numbers(file: Path) -> dict:
    """Rows of a recording, and of each column what is there, its moments and ends."""
    import numpy as np
    import pyarrow.parquet as parquet

    table = parquet.read_table(file)
    out: dict = {"rows": table.num_rows}
    for name in table.column_names:
        column = table.column(name)
        try:
            numbers = column.to_numpy().astype(float)
        except (ValueError, TypeError):
            words = column.to_pylist()
            out[f"columns.{name}"] = {"kinds": len(set(words)), "first": words[0]}
            continue
        good = numbers[np.isfinite(numbers)]
        out[f"columns.{name}"] = {
            "there": len(good),
            "mean": float(good.mean()) if len(good) else None,
            "std": float(good.std()) if len(good) else None,
            "ends": [float(good[0]), float(good[-1])] if len(good) else None,
            "range": [float(good.min()), float(good.max())] if len(good) else None,
        }
    sidecar = file.with_suffix(".toml")
    if sidecar.is_file():
        out["sidecar"] = tomllib.loads(sidecar.read_text())
    return out


def replay_rows(file: Path) -> dict:
    """Rows of each entity of a Rerun recording, and its components."""
    from rerun.chunk import RrdReader

    rows: dict[str, int] = {}
    parts: dict[str, set[str]] = {}
    for chunk in RrdReader(str(file)).stream():
        path = str(chunk.entity_path)
        rows[path] = rows.get(path, 0) + chunk.num_rows
        names = chunk.to_record_batch().schema.names
        parts.setdefault(path, set()).update(n for n in names if not n.startswith("rerun.controls"))
    return {path: {"rows": rows[path], "parts": sorted(parts[path])} for path in sorted(rows)}


def schedule_numbers(file: Path) -> dict:
    """Rows, length and sums of a schedule."""
    with file.open() as stream:
        rows = list(csv.DictReader(stream))
    columns = {name: [float(row[name]) for row in rows] for name in rows[0]}
    return {"rows": len(rows), **{f"sum_{n}": math.fsum(v) for n, v in columns.items()}}


def scene_checks(text: str) -> dict:
    """The verdict's numbers and, by name, each check's state and the numbers that were found."""
    lines = text.splitlines()
    verdict = next((line for line in lines if line.startswith("The scene ")), None)
    if verdict is None:
        raise Absent("no line that begins with 'The scene'")
    out: dict = {"verdict": printed_numbers(verdict), "ready": "is ready" in verdict}
    for line in lines:
        if match := re.match(r"\s+(\S+)\s+(\S.*?)\s{2,}(\S.*?)\s{2,}needs ", line):
            state, name, what = match.groups()
            out[f"checks.{name}"] = {"state": state, "numbers": printed_numbers(what)}
    return out


# ---------------------------------------------------------------------------------------------
# Running commands
# ---------------------------------------------------------------------------------------------


@dataclass
class Done:
    """Result of a command that has ended."""

    folder: Path
    """Folder of the command's files."""
    code: int
    """Exit code."""
    output: str
    """Text on standard output."""


@dataclass
class Session:
    """Folders in which commands run and to which their outputs go."""

    out: Path
    """Folder of the record."""
    inputs: Path
    """Folder of recordings, models and runs that several items read."""
    data: Path
    """Folder of the public data sets."""
    meshes: Path
    """Folder of the public meshes."""
    maps: Path
    """Folder of the import maps."""
    scene: Path
    """Folder of the scene."""
    python: list[str]
    """Command that starts the interpreter under test."""

    def call(self, folder: Path, args: Iterable, codes: tuple[int, ...] = (0,)) -> Done:
        """Run `python -m surgisoft.cli ARGS`, unless it ended there before.

        `{out}` in an argument stands for the folder that the command may write into.
        """
        words = [str(arg).replace("{out}", str(folder)) for arg in args]
        ended = folder / "command.json"
        if ended.is_file():
            before = json.loads(ended.read_text())
            if before["args"] == words and before["exit_code"] in codes:
                return Done(folder, before["exit_code"], (folder / "stdout.txt").read_text())
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        threads = os.environ.get("OMP_NUM_THREADS", "1")
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "COLUMNS": "200", "NO_COLOR": "1"}
        begin = time.perf_counter()
        ran = subprocess.run(
            [*self.python, "-m", "surgisoft.cli", *words],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        (folder / "stdout.txt").write_text(ran.stdout)
        (folder / "stderr.txt").write_text(ran.stderr)
        record = {
            "args": words,
            "exit_code": ran.returncode,
            "seconds": round(time.perf_counter() - begin, 2),
        }
        ended.write_text(json.dumps(record, indent=1))
        if ran.returncode not in codes:
            tail = (ran.stderr or ran.stdout).strip().splitlines()[-1:]
            raise Absent(f"exit code {ran.returncode} of {shlex.join(words)}: {' '.join(tail)}")
        return Done(folder, ran.returncode, ran.stdout)

    def raw(self, name: str, *args, codes: tuple[int, ...] = (0,)) -> Done:
        """Run a command of an item; its output stays in OUT/raw/NAME."""
        return self.call(self.out / "raw" / name, args, codes)

    def made(self, name: str, *args) -> Path:
        """An input that a command with `-o {out}/made...` writes once."""
        kept = self.inputs / name
        if not kept.exists():
            print(f"making the input {name}", flush=True)
            making = self.inputs / ".making" / name
            self.call(making, args)
            kept.parent.mkdir(parents=True, exist_ok=True)
            sidecar = making / Path(name).with_suffix(".toml").name
            if kept.suffix == ".parquet" and sidecar.is_file():
                sidecar.replace(kept.with_suffix(".toml"))
            (making / Path(name).name).replace(kept)
            shutil.rmtree(self.inputs / ".making")
        return kept

    def recording(self, name: str) -> Path:
        """One of `RECORDINGS`, made on the virtual rig."""
        file = f"{name}.parquet"
        return self.made(file, "collect", *RECORDINGS[name].split(), "-o", f"{{out}}/{file}")

    def public(self, name: str) -> Path:
        """One of `PUBLIC`, imported from the public data sets."""
        file = f"{name}.parquet"
        return self.made(file, *self.import_args(name), "-o", f"{{out}}/{file}")

    def import_args(self, name: str) -> list:
        """Arguments of `import` up to the output."""
        patterns, map_name = PUBLIC[name]
        files = [file for pattern in patterns for file in sorted(self.data.glob(pattern))]
        if len(files) < len(patterns):
            raise Skipped(f"no {' or '.join(patterns)} in the folder of --data")
        return ["import", *files, "--map", self.maps / map_name]

    def model(self, name: str) -> Path:
        """One of `MODELS`, fitted to an input recording; `default` is the package's own."""
        if name == "default":
            return Path(name)
        read, words = MODELS[name]
        recording = self.public(read) if read in PUBLIC else self.recording(read)
        return self.made(name, "fit", recording, *words.split(), "-o", f"{{out}}/{name}")

    def policy(self) -> Path:
        """A short training run."""
        return self.made("policy", "train", *CIRCLE.split(), "-o", "{out}/policy")


# ---------------------------------------------------------------------------------------------
# Inputs
# ---------------------------------------------------------------------------------------------

HIDDEN = [
    "hysteresis",
    "rate_dependence",
    "line_lag",
    "creep",
    "softening",
    "stiffening",
    "dead_zone",
    "gain_mismatch",
    "coupling",
    "payload",
    "contact",
    "misalignment",
    "drift",
    "thermal_drift",
    "stick_slip",
    "leak",
    "twist",
    "sensor_crosstalk",
    "marker_slip",
    "breathing",
    "valve_jam",
    "knock",
    "fibre_break",
]
"""What `collect --list-hidden` shows."""

HALF = [
    "hysteresis",
    "line_lag",
    "creep",
    "softening",
    "dead_zone",
    "gain_mismatch",
    "payload",
    "contact",
    "misalignment",
]
"""Effects that are also hidden at half their amplitude, in another robot."""

RECORDINGS = {
    "mixed_0_clean": "mixed --seed 0",
    "mixed_5_clean": "mixed --seed 5",
    **{f"mixed_0_{name}": f"mixed --seed 0 --hidden {name}" for name in HIDDEN},
    **{f"mixed_5_{name}_half": f"mixed --seed 5 --hidden {name}:0.5" for name in HALF},
    "mixed_0_creep_payload": "mixed --seed 0 --hidden creep payload",
    "mixed_0_weight": "mixed --seed 0 --payload-g 4 --roll-deg 90",
    "holds_0_clean": "holds --seed 0 --points 12000",
    "holds_0_creep": "holds --seed 0 --points 12000 --hidden creep",
    "holds_0_drift": "holds --seed 0 --points 12000 --hidden drift",
    "ladder_5_hysteresis": "ladder --seed 5 --points 12000 --hidden hysteresis",
    "ladder_5_softening": "ladder --seed 5 --points 12000 --hidden softening",
    "ladder_5_twist": "ladder --seed 5 --points 12000 --hidden twist",
    "walk": "walk --seed 3 --points 2000",
    "walk_5": "walk --seed 5 --points 4000",
    "test": "test --seed 3",
}
"""Input recording -> arguments of `collect`."""

PUBLIC = {
    "asl_0g": (
        [
            "asl_trunk_payload/control_inputs_controlled_1.csv",
            "asl_trunk_payload/observations_controlled_1.csv",
        ],
        "asl_trunk.toml",
    ),
    "asl_100g": (
        [
            "asl_trunk_payload/control_inputs_controlled_1.csv",
            "asl_trunk_payload/observations_controlled_1_100g.csv",
        ],
        "asl_trunk.toml",
    ),
    "asu": (["asu_two_segment/*.txt.gz"], "asu_two_segment.toml"),
}
"""Imported recording -> files below --data, map (docs/real_data.md)."""

MODELS = {
    "asl_model": ("asl_0g", "--epochs 40 --seed 1"),
    "asu_model": ("asu", "--epochs 20 --seed 1"),
    "arm_5": ("walk_5", "--effects hysteresis --inputs pressure --epochs 60 --seed 1"),
}
"""Input model -> recording, arguments of `fit`. The default arm was fitted to robot 0."""

CIRCLE = "--task track_circle --steps 200000 --seed 1"
RING = "--task circle_ablation --steps 200000 --seed 1"

# ---------------------------------------------------------------------------------------------
# Items
# ---------------------------------------------------------------------------------------------

ITEMS: dict[str, Callable[[Session], dict]] = {}
"""Name of an item -> what records it, in the order of recording."""


def read_json(done: Done, file: str = "answer.json") -> dict:
    """The JSON file that a command wrote into its folder."""
    path = done.folder / file
    if not path.is_file():
        raise Absent(f"no {file} was written")
    return json.loads(path.read_text())


def add(name: str):
    """Add a function to the items."""

    def keep(function):
        ITEMS[name] = function
        return function

    return keep


def add_compare(case: str) -> None:
    """Add an item for `compare` on a recording."""

    @add(f"compare.{case}")
    def _(session: Session) -> dict:
        recording = session.recording(case)
        done = session.raw(
            f"compare.{case}", "compare", "default", recording, "--json", "{out}/answer.json"
        )
        return take(read_json(done), COMPARE)


def add_diagnose(case: str, *more: str, name: str = "", model: str = "default") -> None:
    """More arguments; `@NAME` is one of the recordings."""
    name = f"diagnose.{name or case}"

    @add(name)
    def _(session: Session) -> dict:
        recording = session.recording(case)
        words = [session.recording(w[1:]) if w.startswith("@") else w for w in more]
        judged = session.model(model)
        done = session.raw(
            name, "diagnose", judged, recording, "--json", "{out}/answer.json", *words
        )
        return diagnosed(done)


def diagnosed(done: Done) -> dict:
    """Recorded numbers of a diagnosis."""
    values = take(read_json(done), DIAGNOSE)
    values["ranking"] = values["ranking"][:3]
    return values


def add_fit(name: str, recording: str, words: str) -> None:
    """Add an item for `fit` of a model."""

    @add(f"fit.{name}")
    def _(session: Session) -> dict:
        train, valid = session.recording(recording), session.recording("test")
        done = session.raw(f"fit.{name}", "fit", train, *words.split(), "-o", "{out}/model")
        model = done.folder / "model"
        values = take(json.loads(found(model, "model config").read_text()), MODEL_CONFIG)
        values |= take(json.loads(found(model, "model report").read_text()), MODEL_REPORT)
        judged = session.raw(
            f"fit.{name}.compare", "compare", model, valid, "--json", "{out}/answer.json"
        )
        return values | {"test": take(read_json(judged), FIT_TEST)}


def add_evaluate(name: str, driver: str, words: str, replay: bool = False) -> None:
    """Add an item for `evaluate` of a policy."""

    @add(f"evaluate.{name}")
    def _(session: Session) -> dict:
        return take(read_json(evaluated(session, name, driver, words, replay)), EVALUATE)

    if replay:

        @add(f"replay.{name}")
        def _(session: Session) -> dict:
            done = evaluated(session, name, driver, words, replay)
            return replay_rows(done.folder / "episode.rrd")


def evaluated(session: Session, name: str, driver: str, words: str, replay: bool) -> Done:
    """Run `evaluate` of a policy."""
    who = session.policy() if driver == "policy" else driver
    scene = ["--scene", session.scene] if "circle_ablation" in words else []
    film = ["--replay", "{out}/episode.rrd"] if replay else []
    args = [*words.split(), *scene, "--json", "{out}/answer.json", *film]
    return session.raw(f"evaluate.{name}", "evaluate", who, *args)


def add_collect(name: str, words: str) -> None:
    """Add an item for `collect` of a recording."""

    @add(f"collect.{name}")
    def _(session: Session) -> dict:
        done = session.raw(
            f"collect.{name}", "collect", *words.split(), "-o", "{out}/recording.parquet"
        )
        return recording_numbers(done.folder / "recording.parquet")


def add_scene(name: str, meshes: Callable[[Session], list[str]], words: str = "") -> None:
    """Add an item for `scene new` and `scene check`."""

    @add(f"scene.{name}")
    def _(session: Session) -> dict:
        made = session.raw(
            f"scene.{name}",
            *["scene", "new", *meshes(session), *words.split(), "-o", "{out}/made"],
            codes=(0, 1),
        )
        folder = made.folder / "made"
        checked = session.raw(f"scene.{name}.check", "scene", "check", folder, codes=(0, 1))
        scene = tomllib.loads(found(folder, "scene").read_text())
        return {
            "exit_code": [made.code, checked.code],
            **take(scene, SCENE),
            "new": scene_checks(made.output),
            "check": scene_checks(checked.output),
        }


def openhelp(session: Session) -> list[str]:
    """The liver of the OpenHELP phantom."""
    mesh = session.meshes / "openhelp_liver.stl"
    if not mesh.is_file():
        raise Skipped("no openhelp_liver.stl in the folder of --meshes")
    return [str(mesh)]


def add_amend(name: str, case: str, words: str) -> None:
    """Add an item for `amend` of a model."""

    @add(f"amend.{name}")
    def _(session: Session) -> dict:
        recording = session.recording(case)
        done = session.raw(
            f"amend.{name}",
            *["amend", "default", *words.split(), "--data", recording],
            *["-o", "{out}/model", "--json", "{out}/answer.json"],
            codes=(0, 1),
        )
        values = take(read_json(done), AMEND | AMEND_ONLY)
        return {"exit_code": done.code, **values}


def add_improve(case: str) -> None:
    """Add an item for `improve` of a model."""

    @add(f"improve.{case}")
    def _(session: Session) -> dict:
        recording = session.recording(case)
        done = session.raw(
            f"improve.{case}",
            *["improve", "default", recording, "-o", "{out}/model"],
            *["--json", "{out}/answer.json"],
            codes=(0, 1),
        )
        values = take(read_json(done), AMEND | IMPROVE_ONLY)
        return {"exit_code": done.code, **values}


def add_next_experiment(name: str, words: str, case: str | None = None) -> None:
    """Add an item for `next-experiment`."""

    @add(f"next_experiment.{name}")
    def _(session: Session) -> dict:
        recordings = [session.recording(case)] if case else []
        done = session.raw(
            f"next_experiment.{name}",
            *["next-experiment", "default", *recordings, *words.split()],
            *["-o", "{out}/schedule.csv", "--json", "{out}/answer.json"],
        )
        schedule = schedule_numbers(done.folder / "schedule.csv")
        return {**take(read_json(done), NEXT_EXPERIMENT), "schedule": schedule}


def add_train(name: str, words: str) -> None:
    """Add an item for `train` of a task."""

    @add(f"train.{name}")
    def _(session: Session) -> dict:
        done = session.raw(f"train.{name}", "train", *words.split(), "-o", "{out}/run")
        lines = found(done.folder / "run", "training metrics").read_text().splitlines()
        turns = [json.loads(line) for line in lines]
        for turn in turns:
            for clock in CLOCK:
                turn.pop(clock, None)
        return {"turns": len(turns), "first": turns[0], "last": turns[-1]}


def add_refusal(name: str, *args) -> None:
    """Add an item for a command that must refuse its input."""

    @add(f"refusal.{name}")
    def _(session: Session) -> dict:
        walk = session.recording("walk")
        words = [walk if arg == "@walk" else arg for arg in args]
        done = session.raw(f"refusal.{name}", *words, codes=(0, 1, 2))
        lines = (done.folder / "stderr.txt").read_text().strip().splitlines()
        left = {file.name for file in done.folder.iterdir()}
        written = sorted(left - {"command.json", "stdout.txt", "stderr.txt"})
        return {"exit_code": done.code, "lines": len(lines), "written": written}


for _case in (
    "mixed_0_clean",
    "mixed_0_creep",
    "mixed_0_contact",
    "mixed_0_misalignment",
    "mixed_0_drift",
    "mixed_0_thermal_drift",
    "mixed_5_creep_half",
    "holds_0_clean",
):
    add_compare(_case)

for _case in RECORDINGS:
    if _case.startswith(("mixed", "holds", "ladder")):
        add_diagnose(_case, model="arm_5" if _case.endswith("half") else "default")
add_diagnose("mixed_5_clean", name="own_model", model="arm_5")
add_diagnose("mixed_0_creep", "@holds_0_creep", name="two_recordings")
add_diagnose("mixed_0_drift", "--reference", "@mixed_0_clean", name="reference")
add_diagnose("mixed_0_contact", "--without", "contact", name="without")

add_fit("walk", "walk", "--epochs 200 --seed 1")
add_fit("hysteresis", "walk", "--effects hysteresis --epochs 100 --seed 1")
add_fit("line_lag", "mixed_0_line_lag", "--effects line_lag --inputs pressure --epochs 20 --seed 2")
add_fit("recurrent", "walk", "--network recurrent --epochs 100 --seed 1")
add_fit("constant_curvature", "walk", "--network constant_curvature --epochs 50 --seed 1")

add_evaluate("track_circle", "scripted", "--task track_circle --episodes 4 --seed 5", replay=True)
add_evaluate("track_square", "scripted", "--task track_square --episodes 4 --seed 5")
add_evaluate("track_body", "scripted", "--task track_body --episodes 4 --seed 5")
add_evaluate("laser_plane", "scripted", "--task laser_plane --episodes 4 --seed 5")
add_evaluate("keyhole", "scripted", "--task keyhole --episodes 2 --seed 5", replay=True)
add_evaluate("ring", "scripted", "--task circle_ablation --episodes 2 --seed 5", replay=True)
add_evaluate("random", "random", "--task circle_ablation --episodes 1 --seed 5 --no-referee")
add_evaluate("rig", "scripted", "--task track_circle --episodes 2 --seed 5 --on rig")
add_evaluate(
    "rig_blind",
    "scripted",
    "--task track_square --episodes 2 --seed 5 --on rig --specimen 5 --hidden creep --no-cameras",
)
add_evaluate("rig_ring", "scripted", "--task circle_ablation --episodes 1 --seed 5 --on rig")
add_evaluate("policy", "policy", "--episodes 4 --seed 5")


@add("scene.phantom")
def _(session: Session) -> dict:
    done = session.raw("scene.phantom", "scene", "check", session.scene, codes=(0, 1))
    return {"exit_code": done.code, **scene_checks(done.output)}


add_scene("openhelp", openhelp)
add_scene(
    "gallbladder",
    lambda session: [str(session.scene / "liver.ply"), f"{session.scene}/gallbladder.ply:keep-out"],
    "--diameter 15 --clearance 2",
)


@add("replay.compare")
def _(session: Session) -> dict:
    recording = session.recording("mixed_0_creep")
    done = session.raw(
        "replay.compare", "compare", "default", recording, "--replay", "{out}/comparison.rrd"
    )
    return replay_rows(done.folder / "comparison.rrd")


@add("replay.run")
def _(session: Session) -> dict:
    done = session.raw("replay.run", "replay", session.policy(), "--save", "{out}/episode.rrd")
    return replay_rows(done.folder / "episode.rrd")


def add_import(name: str) -> None:
    """Add an item for `import` of a public data set."""

    @add(f"import.{name}")
    def _(session: Session) -> dict:
        file = f"{name}.parquet"
        done = session.raw(f"import.{name}", *session.import_args(name), "-o", f"{{out}}/{file}")
        shown = session.raw(f"import.{name}.summary", "recording", done.folder / file)
        summary = shown.output.replace(file, "")
        return {"summary": printed_numbers(summary), **recording_numbers(done.folder / file)}


def add_public(command: str, model: str, recording: str, names: Callable[[Done], dict]) -> None:
    """Add an item for a command on a public data set."""
    name = f"import.{command}_{recording}"

    @add(name)
    def _(session: Session) -> dict:
        fitted, file = session.model(model), session.public(recording)
        return names(session.raw(name, command, fitted, file, "--json", "{out}/answer.json"))


for _name in PUBLIC:
    add_import(_name)
add_public("compare", "asl_model", "asl_0g", lambda done: take(read_json(done), COMPARE))
add_public("compare", "asu_model", "asu", lambda done: take(read_json(done), COMPARE))
add_public("diagnose", "asl_model", "asl_100g", diagnosed)


@add("experiment.fault")
def _(session: Session) -> dict:
    done = session.raw(
        "experiment.fault",
        *["experiment", "run", session.scene / "experiments" / "fault.toml", "--repeats", "1"],
        *["--no-replays", "-o", "{out}/results"],
    )
    with found(done.folder / "results", "experiment episodes").open() as stream:
        rows = list(csv.DictReader(stream))
    return {f"{row['setting']}/{row['episode']}": numbers(row) for row in rows}


def numbers(row: dict[str, str]) -> dict:
    """A table's row, what is a number as one."""
    out: dict = {}
    for name, word in row.items():
        try:
            out[name] = float(word)
        except ValueError:
            out[name] = word
    return out


for _name, _words in {
    "grid": "grid --seed 2 --points 200",
    "traverse": "traverse --seed 2 --points 200",
    "walk": "walk --seed 2 --points 200",
    "validation": "validation --seed 2 --points 100",
    "test": "test --seed 2 --points 100",
    "ramps": "ramps --seed 2 --points 2000",
    "reversals": "reversals --seed 2 --points 2000",
    "mixed": "mixed --seed 2 --points 4000 --take 3",
    "weight": "ladder --seed 2 --points 2000 --payload-g 5 --gravity 1 0 0 --roll-deg 30",
    "quiet": "holds --seed 2 --points 2000 --noise-scale 0",
    "hidden": "mixed --seed 2 --points 4000 --hidden " + " ".join(f"{n}:0.7" for n in HIDDEN),
}.items():
    add_collect(_name, _words)

add_refusal("model", "compare", "no_such_model", "@walk")
add_refusal("recording", "diagnose", "default", "no_such_recording.parquet")
add_refusal(
    "hidden", "collect", "mixed", "--hidden", "no_such_effect", "-o", "{out}/recording.parquet"
)
add_refusal(
    *["effect", "amend", "default", "--effect", "no_such_effect", "--data", "@walk"],
    *["-o", "{out}/model"],
)
add_refusal("task", "evaluate", "scripted", "--task", "no_such_task")
add_refusal("scene", "scene", "check", "no_such_scene")

add_amend("creep", "mixed_0_creep", "--effect creep")
add_amend("payload", "mixed_0_payload", "--effect payload --keep-network")
add_amend("line_lag", "mixed_5_line_lag_half", "--effect line_lag")
add_amend("hysteresis", "mixed_5_hysteresis_half", "--effect hysteresis")
add_amend("two", "mixed_0_creep_payload", "--effect creep payload")
add_amend("wrong", "mixed_0_clean", "--effect twist")

add_improve("mixed_0_creep_payload")
add_improve("mixed_0_gain_mismatch")
add_improve("mixed_5_clean")

add_next_experiment("pair", "--between creep,hysteresis")
add_next_experiment("all", "--as-it-stands --minutes 10")
add_next_experiment("recorded", "", "mixed_0_dead_zone")

add_train("track_circle", CIRCLE)
add_train("circle_ablation", RING)


# ---------------------------------------------------------------------------------------------
# The commands of this script
# ---------------------------------------------------------------------------------------------


def chosen(only: str | None) -> list[str]:
    """Items whose names are, or begin with, one of the names between commas."""
    if not only:
        return list(ITEMS)
    names = [name for name in only.split(",") if name]
    for name in names:
        if not any(item == name or item.startswith(f"{name}.") for item in ITEMS):
            raise SystemExit(f"no item {name}; `list` shows them")
    return [i for i in ITEMS if any(i == name or i.startswith(f"{name}.") for name in names)]


def asked_code(python: list[str]) -> dict:
    """Folder and source hash of the package under test."""
    word = "import surgisoft; print(surgisoft.__file__)"
    ran = subprocess.run([*python, "-c", word], capture_output=True, text=True, check=False)
    if ran.returncode:
        raise SystemExit(f"the package does not open:\n{ran.stderr}")
    folder = Path(ran.stdout.split()[-1]).parent
    stamp = hashlib.sha256()
    for file in sorted(folder.rglob("*.py")):
        stamp.update(str(file.relative_to(folder)).encode() + b"\0" + file.read_bytes())
    return {"package": str(folder), "source_sha256": stamp.hexdigest()}


def record(args: argparse.Namespace) -> int:
    """Record the items; exit code 1 where one could not be."""
    out = args.out.resolve()
    python = shlex.split(args.python)
    code = asked_code(python)
    about = out / "about.json"
    out.mkdir(parents=True, exist_ok=True)
    if about.is_file() and json.loads(about.read_text())["source_sha256"] != code["source_sha256"]:
        raise SystemExit(f"{out} was recorded by other code; give a new folder to --out")
    about.write_text(json.dumps(code, indent=1))
    print(f"asking {code['package']}")
    session = Session(
        out,
        (args.inputs or out / "inputs").resolve(),
        args.data.resolve(),
        args.meshes.resolve(),
        args.maps.resolve(),
        args.scene.resolve(),
        python,
    )
    failed = 0
    for name in chosen(args.only):
        kept = out / f"{name}.json"
        if kept.is_file() and "skipped" not in json.loads(kept.read_text()):
            continue
        begin = time.perf_counter()
        try:
            answer = {"values": flat(ITEMS[name](session))}
            said = f"{len(answer['values'])} values"
        except Skipped as reason:
            answer = {"skipped": str(reason)}
            said = f"skipped: {reason}"
        except (Absent, OSError, ValueError, LookupError) as error:
            failed += 1
            print(f"{name:38} FAILED: {error}", flush=True)
            continue
        fresh = kept.with_suffix(".part")
        fresh.write_text(json.dumps(answer, indent=1))
        fresh.replace(kept)
        print(f"{name:38} {said}, {time.perf_counter() - begin:.1f} s", flush=True)
    if failed:
        print(f"{failed} items could not be recorded")
    return int(failed > 0)


def translated(value):
    """Names of a new version as the old one's."""
    if isinstance(value, str):
        for new, old in SAME_NAMES.items():
            value = re.sub(rf"(?<!\w){re.escape(new)}(?!\w)", old, value)
        return value
    if isinstance(value, list):
        return [translated(entry) for entry in value]
    if isinstance(value, dict):
        return {translated(key): translated(entry) for key, entry in value.items()}
    return value


ABSENT = "absent"


def tolerance_of(item: str, key: str) -> Tolerance:
    """The first tolerance whose pattern fits."""
    name = f"{item} {key}"
    return next(limit for pattern, limit in TOLERANCES.items() if fnmatchcase(name, pattern))


def distance(a, b, tolerance: Tolerance) -> float:
    """0 where both are the same, at most 1 within the tolerance, infinite where no number."""
    if math.isinf(tolerance.relative):
        return 0.0 if a == b else 1e-9
    if isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        return max((distance(x, y, tolerance) for x, y in zip(a, b, strict=True)), default=0.0)
    if isinstance(a, dict) and isinstance(b, dict) and a.keys() == b.keys():
        return max((distance(a[key], b[key], tolerance) for key in a), default=0.0)
    if type(a) is int and type(b) is int and not tolerance.counts:
        return 0.0 if a == b else math.inf
    if type(a) in (int, float) and type(b) in (int, float):
        if a == b or (math.isnan(a) and math.isnan(b)):
            return 0.0
        limit = max(tolerance.relative * max(abs(a), abs(b)), tolerance.absolute)
        far = abs(a - b) / limit if limit else math.inf
        return far if math.isfinite(far) else math.inf
    return 0.0 if type(a) is type(b) and a == b else math.inf


def short(value, most: int = 60) -> str:
    """A value for the table."""
    text = json.dumps(value)
    return text if len(text) <= most else f"{text[:most]}..."


def compare(args: argparse.Namespace) -> int:
    """Print item by item what differs; exit code 1 where something does."""
    count = {"equal": 0, "within": 0, "different": 0, "skipped": 0, "not compared": 0}
    for name in chosen(args.only):
        files = [folder / f"{name}.json" for folder in (args.a, args.b)]
        if not any(file.is_file() for file in files):
            continue
        both = [json.loads(f.read_text()) if f.is_file() else None for f in files]
        holds = [both_one is not None and "values" in both_one for both_one in both]
        if not all(holds):
            why = ["missing" if one is None else one.get("skipped", "there") for one in both]
            kind = "skipped" if "missing" not in why and not any(holds) else "not compared"
            count[kind] += 1
            print(f"{name:38} {kind}: {why[0]} | {why[1]}")
            continue
        a, b = (translated(one["values"]) for one in both)
        keys = list(dict.fromkeys([*a, *b]))
        far = {
            key: distance(a.get(key, ABSENT), b.get(key, ABSENT), tolerance_of(name, key))
            for key in keys
        }
        worst = max(far.values(), default=0.0)
        kind = "equal" if worst == 0 else "within" if worst <= 1 else "different"
        count[kind] += 1
        moved = [key for key in sorted(far, key=far.get, reverse=True) if far[key] > 0]
        print(f"{name:38} {kind}" + (f", {len(moved)} of {len(keys)} values" if moved else ""))
        listed = moved if args.all else [k for k in moved if far[k] > 1][: args.most] or moved[:1]
        for key in listed:
            one, other = (short(d.get(key, ABSENT)) for d in (a, b))
            much = "" if math.isinf(far[key]) else f"  ({far[key]:.2g} of the tolerance)"
            print(f"    {key}: {one} | {other}{much}")
        if not args.all and sum(far[k] > 1 for k in moved) > len(listed):
            print(f"    ... {sum(far[k] > 1 for k in moved) - len(listed)} more")
    print(", ".join(f"{number} {kind}" for kind, number in count.items()))
    return int(count["different"] + count["not compared"] > 0)


def main() -> int:
    """Parse the arguments and do what they ask."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    recorder = commands.add_parser("record", help="ask the command line, write the answers")
    recorder.add_argument("--out", type=Path, required=True, help="folder of the answers")
    recorder.add_argument("--only", help="names of items or of groups (diagnose, fit), with commas")
    recorder.add_argument("--python", default=sys.executable, help="how Python is started")
    recorder.add_argument("--inputs", type=Path, help="inputs of an earlier record (OUT/inputs)")
    recorder.add_argument("--data", type=Path, default=Path("../shared/data"), help="public data")
    recorder.add_argument("--meshes", type=Path, default=Path("../shared/meshes"))
    recorder.add_argument("--maps", type=Path, default=Path("docs/examples/maps"))
    recorder.add_argument("--scene", type=Path, default=Path("scenes/phantom_liver"))
    recorder.set_defaults(do=record)
    comparer = commands.add_parser("compare", help="compare two records")
    comparer.add_argument("a", type=Path)
    comparer.add_argument("b", type=Path)
    comparer.add_argument("--only", help="names of items or of groups, with commas")
    comparer.add_argument("--most", type=int, default=5, help="most differences shown of an item")
    comparer.add_argument("--all", action="store_true", help="show whatever is not equal")
    comparer.set_defaults(do=compare)
    lister = commands.add_parser("list", help="names of the items")
    lister.set_defaults(do=lambda _: print("\n".join(ITEMS)) or 0)
    args = parser.parse_args()
    return args.do(args)


if __name__ == "__main__":
    sys.exit(main())
