"""The demonstration: what the package does, in five steps on files of its own.

Two trained policies cut a ring around a lesion. Then the virtual rig records an arm that creeps,
the model of the package is compared with the recording, the missing effect is named, and the model
is amended. Every step is the command that it prints; one page shows them all.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path

from surgisoft.agents.report import episode_parts
from surgisoft.agents.session import Evaluations, evaluate
from surgisoft.diagnosis.amend import Amendment, amend
from surgisoft.diagnosis.compare import Compared, Comparison, compare
from surgisoft.diagnosis.diagnose import Diagnosis, diagnose
from surgisoft.diagnosis.pages.amendment import amend_page, track_charts
from surgisoft.diagnosis.pages.compare import write_report
from surgisoft.diagnosis.pages.diagnosis import diagnosis_page
from surgisoft.diagnosis.residuals import residual_table
from surgisoft.errors import InputError
from surgisoft.files import new_folder
from surgisoft.measurement.recordings import save_recording
from surgisoft.progress import Progress, silent
from surgisoft.replay.episode_view import write_replay
from surgisoft.replay.model_error import write_compared, write_models
from surgisoft.replay.show import open_replay
from surgisoft.report import Command, Page, Picture, Section, Text, write_page
from surgisoft.rig.trial import collect
from surgisoft.surrogate.checkpoint import save_model

FOLDER = "surgisoft_demo"
"""Default folder of the demonstration."""
POLICY = "ring"
"""The trained policies of the package."""
HIDDEN = "creep"
"""The hidden effect of the robot that is recorded: the wall yields slowly under load."""
POINTS = 6000
"""Samples of the recording: five minutes of the bench at 20 Hz."""
BROAD_PX = 620
"""Width below which a broad picture scrolls, pixels."""
STEPS = ("cut", "measure", "compare", "diagnose", "amend")
"""Names of the steps, in their order."""


@dataclass(frozen=True, eq=False)
class Demonstration:
    """What the five steps found, and where their page lies."""

    cut: Evaluations
    """Step 1: an episode of the trained policies."""
    comparison: Comparison
    """Step 3: the model's error on the recording."""
    diagnosis: Diagnosis
    """Step 4: the effect that the model lacks."""
    amendment: Amendment | None
    """Step 5: the model with that effect; None where none was named."""
    page: Path
    """The page with all five steps."""
    no_picture: str
    """Why there is no picture of the replay; empty where there is one."""

    @property
    def sentences(self) -> dict[str, str]:
        """Result of each step in one sentence, by its name."""
        return {
            "cut": _cut_sentence(self.cut),
            "measure": f"a robot with hidden {HIDDEN} was recorded for {POINTS // 20} s",
            "compare": self.comparison.sentence,
            "diagnose": self.diagnosis.verdict.sentence,
            "amend": self.amendment.sentence if self.amendment else "no effect was named to add",
        }


def demo(
    folder: str | Path = FOLDER, *, policy: str | Path = POLICY, progress: Progress = silent
) -> Demonstration:
    """Run the demonstration into a new folder, whose `index.html` shows it.

    The folder appears when all five are done. policy: the training run of `circle_ablation` that
    cuts the ring; by default the one of the package. Raises InputError where the folder is not
    empty or cannot be written.
    """
    folder = Path(folder)
    _claim(folder)
    with new_folder(folder) as fresh:
        result = _five_steps(fresh, policy, progress)
    return replace(result, page=folder / result.page.name)


def _five_steps(folder: Path, policy: str | Path, progress: Progress) -> Demonstration:
    """Run the five steps and write their files into an existing folder."""
    progress(0, 100, "step 1 of 5: two arms cut a ring")
    cut = evaluate(policy, "circle_ablation", episodes=1, log=(str(policy),))
    log = cut.logs[str(policy)]
    write_replay(log, folder / "cut.rrd")
    progress(25, 100, "step 1 of 5: picture of the replay")
    picture, no_picture = _replay_picture(folder / "cut.rrd", folder / "cut.png")

    progress(40, 100, "step 2 of 5: a robot is recorded")
    recording = collect("mixed", seed=0, points=POINTS, hidden=[HIDDEN])
    save_recording(recording, folder / "bench.parquet")

    progress(60, 100, "step 3 of 5: the model is compared with it")
    comparison, table = compare("default", folder / "bench.parquet")
    compared = [Compared("default", comparison, table)]
    _, *drawn = write_report(compared, folder / "compare", "default on bench")
    write_compared(compared, "default on bench", folder / "compare.rrd")

    progress(70, 100, "step 4 of 5: which effect is missing?")
    found = diagnose("default", folder / "bench.parquet")
    write_page(diagnosis_page(found, "default"), folder / "diagnosis.html")

    progress(80, 100, "step 5 of 5: the effect is added")
    amendment = None
    if found.verdict.effects:
        amendment = amend("default", folder / "bench.parquet", list(found.verdict.effects))
        save_model(amendment.model, folder / "amended")
        page = amend_page(amendment, "default, amended", amendment.model.summary())
        write_page(page, folder / "amendment.html")
        tables = {"before": table, "after": residual_table(amendment.model, [recording])}
        title = "Before and after the amendment"
        write_models(tables, title, folder / "amended.rrd", amendment.sentence)

    result = Demonstration(cut, comparison, found, amendment, folder / "index.html", no_picture)
    write_page(_page(result, log, picture, drawn), result.page)
    progress(100, 100, "done")
    return result


def _claim(folder: Path) -> None:
    """Raise InputError unless the folder can be made, or is empty."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: already there; choose another folder with -o")
    if folder.resolve() == Path.cwd():
        raise InputError(f"{folder}: is the present folder, expected a new one; name it with -o")
    above = next(place for place in folder.absolute().parents if place.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be written, {above} is not a writable folder")


def _replay_picture(replay: Path, file: Path) -> tuple[Path | None, str]:
    """A picture of a replay, and why there is none: the viewer needs a Vulkan driver."""
    try:
        open_replay(replay, screenshot=file)
    except (InputError, OSError, RuntimeError) as error:
        return None, " ".join(str(error).split())
    return file, ""


def _page(result: Demonstration, log, picture: Path | None, drawn: list[Path]) -> Page:
    """The page with all five steps."""
    said = {name: text[:1].upper() + text[1:] + "." for name, text in result.sentences.items()}
    cut: list = [
        Command(f"surgisoft evaluate {POLICY} --episodes 1 --replay cut.rrd"),
        Text(said["cut"]),
        Text(
            "Two soft arms over a liver phantom: one carries the laser, the other the endoscope. "
            "The policies see pressures, key points and the lesion. An exact collision checker "
            "(FCL) decides what the beam hits. Look around in the replay: "
            "`surgisoft replay cut.rrd`"
        ),
    ]
    if picture is not None:
        cut.append(Picture.from_file(picture, "The episode in the Rerun viewer", "cut.rrd"))
    cut += episode_parts(log)[:-1]
    amended: list = [Text(said["amend"])]
    if result.amendment is not None:
        names = " ".join(result.amendment.effects)
        amended = [
            Command(f"surgisoft amend default --effect {names} --data bench.parquet -o amended"),
            *amended,
            *track_charts(
                {"Held-out part of the recording": result.amendment.tracks[1]},
                result.amendment.held_out.floor,
            ),
            Text(
                "The folder amended holds the new model; it is used like any other, for example "
                "by `surgisoft train --task track_circle --arm amended`. "
                "Details: `amendment.html`; before and after in 3-D: "
                "`surgisoft replay amended.rrd`"
            ),
        ]
    return Page(
        title="surgisoft in five steps",
        verdict=said["amend"],
        about="surgisoft demo",
        tone="good" if result.amendment is not None and result.amendment.claimed else "warn",
        parts=[
            Section("1. Two arms cut a ring around a lesion", cut),
            Section(
                "2. A robot is measured",
                [
                    Command(
                        f"surgisoft collect mixed --points {POINTS} --hidden {HIDDEN} "
                        "-o bench.parquet"
                    ),
                    Text(
                        "The virtual rig plays a robot that creeps: its wall yields slowly under "
                        "load. The model does not know. On a bench of your own the recording comes "
                        "from `surgisoft import` or from a rig driver."
                    ),
                ],
            ),
            Section(
                "3. Where does the model fail?",
                [
                    Command("surgisoft compare default bench.parquet --report compare"),
                    Text(said["compare"]),
                    *_error_pictures(drawn),
                    Text("Details: `compare/report.html`; in 3-D: `surgisoft replay compare.rrd`"),
                ],
            ),
            Section(
                "4. Which physical effect is missing?",
                [
                    Command("surgisoft diagnose default bench.parquet"),
                    Text(said["diagnose"]),
                    *_ranking_parts(result.diagnosis),
                    Text("Details: `diagnosis.html`"),
                ],
            ),
            Section("5. The effect is added, and the error falls", amended),
        ],
    )


def _cut_sentence(cut: Evaluations) -> str:
    (result,) = cut.results
    numbers = {name: value.mean for name, value in result.overall.items()}
    whole = numbers["success"] == 1.0
    return (
        f"{'the whole ring was cut' if whole else 'the ring was not cut'} in "
        f"{numbers['time_s']:.0f} s, the beam's mean error was "
        f"{numbers['beam_error_mean_mm']:.3f} mm, the smallest clearance "
        f"{numbers['clearance_mm']:.0f} mm"
    )


def _error_pictures(drawn: list[Path]) -> list:
    """Body, loops and error; the broad ones scroll on a narrow page."""
    by_name = {path.stem: path for path in drawn}
    return [
        Picture.from_file(by_name["body"], "Measured and predicted bodies", drawn=True),
        Picture.from_file(
            by_name["loops"], "Loops, measured and predicted", "", BROAD_PX, drawn=True
        ),
        Picture.from_file(by_name["error"], "Error over the recording", "", BROAD_PX, drawn=True),
    ]


def _ranking_parts(found: Diagnosis) -> list:
    """Chart and table of the ranked effects, as on the page of the diagnosis."""
    page = diagnosis_page(found, "default")
    section = next((p for p in page.parts if isinstance(p, Section) and p.title == "Effects"), None)
    return list(section.parts) if section is not None else []
