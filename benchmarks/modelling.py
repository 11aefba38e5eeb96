"""Benchmark `modelling`: prediction errors of models as in the paper, on the virtual rig."""

import multiprocessing
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from surgisoft.files import read_json, write_json
from surgisoft.progress import Progress
from surgisoft.workers import begin_worker

ARCHITECTURES = ("64,64", "128,128", "64,64,64", "128,128,128", "64,64,64,64", "128,128,128,128")
"""Six HAW-NN architectures of 2 to 4 hidden layers (the paper does not list those it used)."""
PAPER = {"pressure": 0.3947, "pressure+direction": 0.0693}
"""Lowest test MSE of the paper on its real robot (Chen et al. 2025, sec. V-A)."""
RECURRENT_EPOCHS = 100
"""Largest number of epochs of the recurrent baseline, which uses early stopping."""


@dataclass(frozen=True)
class Case:
    """One model to fit."""

    name: str
    """Name in the table."""
    inputs: str
    """`pressure` or `pressure+direction`."""
    options: dict
    """Arguments of `FitConfig`."""


@dataclass(frozen=True)
class Outcome:
    """One fitted model on one robot's test set."""

    seed: int
    """Seed of the robot."""
    case: Case
    """Name of the model's case."""
    mse_mm2: float
    """Test MSE of a coordinate, mm^2."""
    rmse_mm: float
    """Test RMSE of a key point's distance, mm."""
    per_key_point_mm: tuple[float, ...]
    """Test RMSE of each key point's distance, base to tip, mm."""
    seconds: float
    """Duration of the fit, s."""
    kept: str
    """Summary of the fitted model."""


def cases() -> list[Case]:
    """Every model of the study."""
    rows = [Case("constant curvature", "pressure", {"network": "constant_curvature"})]
    for widths in ARCHITECTURES:
        hidden = tuple(int(width) for width in widths.split(","))
        for inputs in ("pressure", "pressure+direction"):
            name = f"HAW-NN {len(hidden)} x {hidden[0]}"
            rows.append(Case(name, inputs, {"hidden": hidden, "inputs": inputs}))
    rows.append(
        Case(
            "recurrent (GRU 64)",
            "pressure+direction",
            {"network": "recurrent", "epochs": RECURRENT_EPOCHS},
        )
    )
    rows.append(
        Case("HAW-NN 4 x 128 + hysteresis", "pressure+direction", {"effects": ("hysteresis",)})
    )
    return rows


def collect(seed: int, folder: Path, points: int | None) -> float:
    """Record training, validation and test sets of one robot; the test set's floor in mm^2.

    The floor is the mean square of what the cameras add to each coordinate, from the plant itself.
    """
    from surgisoft.measurement.protocols import make_protocol
    from surgisoft.measurement.recordings import save_recording
    from surgisoft.rig import VirtualRig

    floor = 0.0
    for take, name in enumerate(("grid", "validation", "test", "ladder")):
        rig = VirtualRig(seed=seed, take=take)
        scaled = points if name == "grid" else None
        protocol = make_protocol(name, rig.limits, points=scaled, seed=seed + 1000 * take)
        recording, truth = rig.record(protocol)
        save_recording(recording, folder / f"{name}-{seed}.parquet")
        if name == "test":
            noise = recording.key_points_mm - truth.noise_free_mm
            floor = float(np.nanmean(np.square(noise)))
    return floor


def fit_one(task: tuple[int, Case, Path]) -> Outcome:
    """Fit one model on one robot and evaluate it on the test set; the folder stores both."""
    import torch

    from surgisoft.diagnosis.compare import compare
    from surgisoft.measurement.histories import arm_spec, history_of
    from surgisoft.measurement.recordings import load_recording
    from surgisoft.surrogate.checkpoint import save_model
    from surgisoft.surrogate.fit import FitConfig, fit

    torch.set_num_threads(1)
    seed, case, folder = task
    train, valid, test = (
        load_recording(folder / f"{name}-{seed}.parquet") for name in ("grid", "validation", "test")
    )
    result = fit(
        history_of([train]),
        history_of([valid]),
        arm_spec([train]),
        FitConfig(**{"prior": "none"} | case.options),
    )
    comparison, _ = compare(result.model, [test])
    save_model(result.model, folder / model_name(seed, case), force=True)
    network = result.model.network
    kept = "pressure+direction" if network.directions else "pressure"
    outcome = Outcome(
        seed,
        case,
        comparison.mse_mm2,
        comparison.rmse_mm,
        comparison.per_key_point_mm,
        result.seconds,
        " + ".join([kept, *result.model.effects]),
    )
    numbers = asdict(outcome)
    del numbers["case"]
    write_json(outcome_file(task), numbers)
    return outcome


def outcome_file(task: tuple[int, Case, Path]) -> Path:
    """File of the numbers of one fitted model."""
    seed, case, folder = task
    return folder / f"{model_name(seed, case)}.json"


def stored(task: tuple[int, Case, Path]) -> Outcome | None:
    """The outcome of an earlier run in this folder, None where there is none."""
    file = outcome_file(task)
    if not file.is_file():
        return None
    numbers = read_json(file)
    points = tuple(numbers.pop("per_key_point_mm"))
    return Outcome(case=task[1], per_key_point_mm=points, **numbers)


def model_name(seed: int, case: Case) -> str:
    """Name of the folder of one fitted model."""
    plain = "".join(letter if letter.isalnum() else "-" for letter in f"{case.name}-{case.inputs}")
    return f"model-{seed}-{plain}"


def run(
    seeds: list[int],
    points: int | None,
    processes: int,
    report: Progress,
    work: Path,
    images: Path | None = None,
) -> str:
    """Run the whole study and return its Markdown.

    work: folder of recordings, models and numbers; what an earlier run left there is not repeated.
    images: folder for pictures of one robot.
    """
    folder = work / ("paper" if points is None else f"{points}-points")
    folder.mkdir(parents=True, exist_ok=True)
    floors = {}
    for number, seed in enumerate(seeds):
        report(number, len(seeds), f"collecting robot {seed}")
        kept = folder / f"floor-{seed}.json"
        if not kept.is_file():
            write_json(kept, collect(seed, folder, points))
        floors[seed] = float(read_json(kept))
    tasks = [(seed, case, folder) for seed in seeds for case in reversed(cases())]
    outcomes = [outcome for task in tasks if (outcome := stored(task)) is not None]
    left = [task for task in tasks if not outcome_file(task).is_file()]
    context = multiprocessing.get_context("spawn")
    with context.Pool(processes, begin_worker) as pool:
        for outcome in pool.imap_unordered(fit_one, left):
            outcomes.append(outcome)
            report(len(outcomes), len(tasks), f"robot {outcome.seed}: {outcome.case.name}")
    if images is not None:
        draw(seeds[0], folder, images)
    return markdown(seeds, floors, outcomes)


def draw(seed: int, folder: Path, images: Path) -> None:
    """Draw loops of three models on an amplitude ladder, and bodies of the best, of one robot."""
    from surgisoft.diagnosis.pages.pictures import bodies, ladder_loops, save
    from surgisoft.diagnosis.residuals import residual_table
    from surgisoft.measurement.recordings import load_recording
    from surgisoft.surrogate.checkpoint import load_model

    ladder = load_recording(folder / f"ladder-{seed}.parquet")
    test = load_recording(folder / f"test-{seed}.parquet")
    deep = {case.inputs: case for case in cases() if case.name == "HAW-NN 4 x 128"}
    picked = {
        "pressure": deep["pressure"],
        "pressure + direction": deep["pressure+direction"],
        "with hysteresis": cases()[-1],
    }
    models = {label: load_model(folder / model_name(seed, c)) for label, c in picked.items()}
    tables = {label: residual_table(model, [ladder]) for label, model in models.items()}
    images.mkdir(parents=True, exist_ok=True)
    save(ladder_loops(tables, "kPa"), images / "loops.png")
    best = residual_table(models["with hysteresis"], [test])
    save(bodies({"with hysteresis": best}), images / "body.png")


def removed(outcomes: list[Outcome], floors: dict[int, float], seed: int) -> float:
    """Share of the MSE between pressure-only and floor that memory removes, on one robot."""
    own = [outcome for outcome in outcomes if outcome.seed == seed]
    plain = min(
        outcome.mse_mm2
        for outcome in own
        if outcome.case.inputs == "pressure" and outcome.case.name.startswith("HAW-NN")
    )
    memory = next(outcome.mse_mm2 for outcome in own if outcome.case.options.get("effects"))
    return (plain - memory) / (plain - floors[seed])


def markdown(seeds: list[int], floors: dict[int, float], outcomes: list[Outcome]) -> str:
    """Tables of the study as Markdown."""
    robots = " | ".join(f"robot {seed}" for seed in seeds)
    lines = [
        f"| model | inputs | {robots} | mean MSE mm2 | RMSE mm | key points base to tip, mm | s |",
        "|---|---|" + "---|" * (len(seeds) + 4),
    ]
    for case in cases():
        own = {o.seed: o for o in outcomes if o.case.name == case.name and o.case == case}
        values = [own[seed] for seed in seeds]
        points = np.sqrt(np.mean(np.square([o.per_key_point_mm for o in values]), axis=0))
        lines.append(
            f"| {case.name} | {case.inputs} | "
            + " | ".join(f"{o.mse_mm2:.5f}" for o in values)
            + f" | {np.mean([o.mse_mm2 for o in values]):.5f}"
            + f" | {np.sqrt(np.mean(np.square([o.rmse_mm for o in values]))):.4f}"
            + f" | {' '.join(f'{value:.3f}' for value in points)}"
            + f" | {np.mean([o.seconds for o in values]):.0f} |"
        )
    lines.append(
        "| noise floor (cameras) | | "
        + " | ".join(f"{floors[seed]:.5f}" for seed in seeds)
        + f" | {np.mean(list(floors.values())):.5f} | | | |"
    )
    lines += ["", *_sentences(seeds, floors, outcomes)]
    return "\n".join(lines) + "\n"


def _sentences(seeds, floors, outcomes) -> list[str]:
    names = {case.name for case in cases() if "hidden" in case.options}

    def lowest(inputs: str) -> float:
        """Lowest mean over robots of the six architectures."""
        return min(
            np.mean([o.mse_mm2 for o in outcomes if o.case == case])
            for case in cases()
            if case.inputs == inputs and case.name in names
        )

    plain, direction = lowest("pressure"), lowest("pressure+direction")
    memory = np.mean([o.mse_mm2 for o in outcomes if o.case.options.get("effects")])
    paper = 1 - PAPER["pressure+direction"] / PAPER["pressure"]
    shares = [removed(outcomes, floors, seed) for seed in seeds]
    kept = sorted({o.kept for o in outcomes if o.case.options.get("effects")})
    return [
        f"Lowest mean of six architectures: {plain:.4f} mm2 with pressure only, "
        f"{direction:.4f} mm2 with direction: {1 - direction / plain:.1%} less.",
        f"The paper, on its real robot: {PAPER['pressure']} and {PAPER['pressure+direction']}, "
        f"which is {paper:.1%} less (its abstract says 84.95 %).",
        f"With the hysteresis effect: {memory:.5f} mm2, {1 - memory / plain:.1%} less than "
        f"pressure only. Kept by the fit: {', '.join(kept)}.",
        "Share of the error between pressure-only and the noise floor that memory removes: "
        + ", ".join(
            f"{share:.1%} (robot {seed})" for share, seed in zip(shares, seeds, strict=True)
        )
        + ".",
    ]
