"""The demonstration: what the package does, in five steps on files of its own.

Two trained policies cut a ring around a lesion. Then the virtual rig records an arm that creeps,
the model of the package is compared with the recording, the missing effect is named, and the model
is amended. Every step is the command that it prints; one page shows them all.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
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
from surgisoft.errors import InputError, path_of
from surgisoft.files import note_written, resolved
from surgisoft.measurement.recordings import Recording, load_recordings
from surgisoft.progress import Progress, Stages, silent
from surgisoft.replay.episode_view import write_replay
from surgisoft.replay.model_error import write_compared, write_models
from surgisoft.replay.show import open_replay
from surgisoft.report import Command, Page, Part, Picture, Section, Text, write_page
from surgisoft.report.charts import AMBER, BLUE, GREEN, chart, drawing, plt
from surgisoft.surrogate.checkpoint import save_model
from surgisoft.time_axis import continued, with_gaps
from surgisoft.workers import ONE_THREAD, torch_threads

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
RECORDING = "bench.parquet"
"""File of the recording."""
STEPS = (
    ("cut", "Two arms cut a ring around a lesion"),
    ("measure", "A robot is measured"),
    ("compare", "Where does the model fail?"),
    ("diagnose", "Which physical effect is missing?"),
    ("amend", "The effect is added, and the error falls"),
)
"""Name and title of each step, in their order."""


@dataclass(frozen=True, eq=False)
class Demonstration:
    """Results of the five steps, and the path of their page."""

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
    sentences: dict[str, str]
    """Result of each step in one sentence, by its name."""


@torch_threads(1)
def demo(
    folder: str | Path = FOLDER,
    *,
    policy: str | Path = POLICY,
    progress: Progress = silent,
    on_step: Callable[[str, str], None] = lambda name, sentence: None,
) -> Demonstration:
    """Run the demonstration into a new folder, whose `index.html` shows it.

    The page is there after the first step and grows with each: most of the time of a first run is
    compilation, and the picture of the cut need not wait for it. Every file is written whole.
    policy: the training run of `circle_ablation` that cuts the ring; by default the one of the
    package. on_step: called with name and result of each step. Raises InputError where the folder
    is not empty or cannot be written. This process and the one that records compute on one thread
    each: the tensors of one episode are too small for two.
    """
    folder = path_of("the folder", folder)
    _claim(folder)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with _recorder(folder / RECORDING) as recorded:
            return _five_steps(folder, policy, progress, on_step, recorded)
    finally:
        with contextlib.suppress(OSError):
            folder.rmdir()  # of a demonstration that ended before its first file


def _five_steps(
    folder: Path,
    policy: str | Path,
    progress: Progress,
    on_step: Callable[[str, str], None],
    recorded: Callable[[], None],
) -> Demonstration:
    """Run the five steps and write their files into an existing folder.

    recorded: waits for the recording, which is made meanwhile.
    """
    story = _Story(folder / "index.html", on_step)
    try:
        return _told(story, folder, policy, progress, recorded)
    except BaseException:
        story.end_early()
        raise


def _told(
    story: "_Story", folder: Path, policy: str | Path, progress: Progress, recorded
) -> Demonstration:
    """Run the five steps, each told when it is done."""
    stages = Stages(progress, 100)
    cutting = stages.stage(25, "step 1 of 5: two arms cut a ring")
    cut = evaluate(
        policy,
        "circle_ablation",
        episodes=1,
        log=(str(policy),),
        progress=lambda done, total, _="": cutting(done, total),
    )
    log = cut.logs[str(policy)]
    write_replay(log, folder / "cut.rrd")
    charts = episode_parts(log)[:-1]
    story.tell(
        f"evaluate {policy} --episodes 1 --replay cut.rrd",
        cut_sentence(cut),
        _cut_parts(charts, None),
    )
    stages.stage(15, "step 1 of 5: picture of the replay")
    picture, no_picture = _replay_picture(folder / "cut.rrd", folder / "cut.png")
    if picture is not None:
        story.show_more(_cut_parts(charts, picture))

    stages.stage(20, "step 2 of 5: a robot is recorded")
    recorded()
    story.tell(
        " ".join(_collect_arguments(RECORDING)),
        f"a robot with hidden {HIDDEN} was recorded for {POINTS // 20} s",
        _measured_parts(load_recordings(folder / RECORDING)[0]),
    )

    stages.stage(10, "step 3 of 5: the model is compared with it")
    comparison, table = compare("default", folder / RECORDING)
    compared = [Compared("default", comparison, table)]
    _, *drawn = write_report(compared, folder / "compare", "default on bench")
    write_compared(compared, "default on bench", folder / "compare.rrd")
    story.tell(
        f"compare default {RECORDING} --report compare",
        comparison.sentence,
        _error_pictures(drawn),
    )

    stages.stage(10, "step 4 of 5: which effect is missing?")
    found = diagnose("default", folder / RECORDING)
    write_page(diagnosis_page(found, "default"), folder / "diagnosis.html")
    story.tell(f"diagnose default {RECORDING}", found.verdict.sentence, _ranking_parts(found))

    stages.stage(20, "step 5 of 5: the effect is added")
    amendment, command = None, ""
    if found.verdict.effects:
        names = " ".join(found.verdict.effects)
        command = f"amend default --effect {names} --data {RECORDING} -o amended"
        amendment = amend("default", folder / RECORDING, list(found.verdict.effects))
        save_model(amendment.model, folder / "amended")
        page = amend_page(amendment, "default, amended", amendment.model.summary())
        write_page(page, folder / "amendment.html")
        recordings = load_recordings([folder / RECORDING])
        tables = {"before": table, "after": residual_table(amendment.model, recordings)}
        title = "Before and after the amendment"
        write_models(tables, title, folder / "amended.rrd", amendment.sentence)
    story.tell(
        command,
        amendment.sentence if amendment else "no effect was named, so none was added",
        _amended_parts(amendment),
        tone="good" if amendment is not None and amendment.claimed else "warn",
    )
    progress(100, 100, "done")
    return Demonstration(
        cut, comparison, found, amendment, story.page, no_picture, dict(story.sentences)
    )


@contextlib.contextmanager
def _recorder(file: Path) -> Iterator[Callable[[], None]]:
    """Record the robot in a process of its own; yields a function that waits for the recording.

    A first run compiles the rig for half a minute, while this process compiles the scene. Leaving
    the block ends the process; what it wrote is noted (`surgisoft.files.noted_writes`).
    """
    command = [sys.executable, "-m", "surgisoft", *_collect_arguments(str(file))]
    quiet = subprocess.DEVNULL
    child = subprocess.Popen(
        command,
        stdin=quiet,
        stdout=quiet,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        env=os.environ | dict.fromkeys(ONE_THREAD, "1"),
    )

    def wait() -> None:
        _, errors = child.communicate()
        if child.returncode:
            why = errors.strip().splitlines()[-1:] or [f"it ended with status {child.returncode}"]
            raise InputError(f"the robot could not be recorded: {why[0]}")

    try:
        yield wait
    finally:
        if child.poll() is None:
            child.terminate()
            child.communicate()
        for written in (file, file.with_suffix(".toml")):
            if written.exists():  # each is written whole, or not at all
                note_written(written)


def _collect_arguments(file: str) -> list[str]:
    """The command line that records the robot."""
    return ["collect", "mixed", "--points", str(POINTS), "--hidden", HIDDEN, "-o", file]


def _claim(folder: Path) -> None:
    """Raise InputError unless the folder can be made, or is empty."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: already exists; choose another folder with -o")
    if resolved(folder) == Path.cwd():
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


RELOAD = "reload this page to see the results so far."
MORE = ("", f" One more step follows; {RELOAD}", f" {{}} more steps follow; {RELOAD}")
"""What the page says of the steps that are left: of none, of one, of more."""
ENDED_EARLY = " The demonstration was ended before the next step ({} of 5 are left)."
"""What it says where none will follow."""


@dataclass
class _Story:
    """The page of the demonstration, which grows by a section with each step."""

    page: Path
    """Its file."""
    on_step: Callable[[str, str], None]
    """Called with name and result of each step."""
    sentences: dict[str, str] = field(default_factory=dict)
    """Result of each step so far, by its name."""
    sections: list[Section] = field(default_factory=list)
    """Sections of the page so far."""
    begin: list[Part] = field(default_factory=list)
    """What the last section begins with: command and result."""
    tone: str = "plain"
    """Colour of the page's verdict."""

    def tell(self, command: str, sentence: str, parts: Sequence[Part], tone: str = "plain") -> None:
        """Add the next step, and write the page.

        command: what it ran, empty where it ran nothing. tone: colour of the page's verdict.
        """
        name, title = STEPS[len(self.sections)]
        said = f"{sentence[:1].upper()}{sentence[1:]}."
        told: list[Part] = [Command(f"surgisoft {command}")] if command else []
        self.begin, self.tone = [*told, Text(said)], tone
        self.sections.append(Section(f"{len(self.sections) + 1}. {title}", [*self.begin, *parts]))
        self.sentences[name] = sentence
        self._write(MORE[min(self._left, 2)])
        self.on_step(name, sentence)

    def show_more(self, parts: Sequence[Part]) -> None:
        """Show other parts in the last section, and write the page."""
        self.sections[-1] = Section(self.sections[-1].title, [*self.begin, *parts])
        self._write(MORE[min(self._left, 2)])

    def end_early(self) -> None:
        """Say on the page that no further step follows; without a step there is no page."""
        if self.sections and self._left:
            with contextlib.suppress(OSError):  # what ended it is told, not this
                self._write(ENDED_EARLY)

    @property
    def _left(self) -> int:
        return len(STEPS) - len(self.sections)

    def _write(self, following: str) -> None:
        """Write the page; following: what its verdict says of the steps that are left."""
        said = list(self.sentences.values())[-1]
        verdict = f"{said[:1].upper()}{said[1:]}.{following.format(self._left)}"
        page = Page("surgisoft in five steps", verdict, self.sections, "surgisoft demo", self.tone)
        write_page(page, self.page)


def _cut_parts(charts: Sequence[Part], picture: Path | None) -> list[Part]:
    """What step 1 shows: the replay's picture, and charts of the episode."""
    parts: list[Part] = [
        Text(
            "Two soft arms over a liver phantom: one carries the laser, the other the endoscope. "
            "The policies see pressures, key points and the lesion. An exact collision checker "
            "(FCL) decides what the beam hits. Look around in the replay: "
            "`surgisoft replay cut.rrd`"
        ),
    ]
    if picture is not None:
        shown = "The episode in the Rerun viewer, at two thirds of its time"
        parts.append(Picture.from_file(picture, shown, shown))
    return [*parts, *charts]


def _measured_parts(recording: Recording) -> list[Part]:
    """What step 2 shows: actuation and tip over time."""
    return [
        Text(
            "The virtual rig simulates a robot that creeps: its wall yields slowly under load. The "
            "model does not contain creep. On a bench of your own the recording comes from "
            "`surgisoft import` or from a rig driver."
        ),
        _recording_chart(recording),
    ]


def _recording_chart(recording: Recording) -> Picture:
    """Pressures and position of the tip over time; the runs stand one after another."""
    time_s, tip = continued(recording.t_s), recording.key_points_mm[:, -1]
    with drawing():
        figure, (top, below) = plt.subplots(2, 1, figsize=(7.2, 3.4), sharex=True)
        columns = [
            (top, recording.measured, [f"chamber {i + 1}" for i in range(3)]),
            (below, tip - tip[0], ["x", "y", "z"]),
        ]
        for axis, values, labels in columns:
            for column, colour, label in zip(values.T, (BLUE, AMBER, GREEN), labels, strict=True):
                axis.plot(*with_gaps(time_s, column), c=colour, lw=0.8, label=label)
            axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        top.set_ylabel(f"pressure [{recording.unit}]")
        below.set_ylabel("tip [mm]")
        below.set_xlabel("time [s]")
        what = "The recording: pressures, and how far the tip moved from where it began"
        return replace(chart(figure, what, what), least_px=BROAD_PX)


def _amended_parts(amendment: Amendment | None) -> list[Part]:
    """What step 5 shows: the error of the held-out part before and after."""
    if amendment is None:
        return []
    return [
        *track_charts(
            {"Held-out part of the recording": amendment.tracks[1]}, amendment.held_out.floor
        ),
        Text(
            "The folder amended holds the new model; it is used like any other, for example "
            "by `surgisoft train --task track_circle --arm amended`. "
            "Details: `amendment.html`; before and after in 3-D: "
            "`surgisoft replay amended.rrd`"
        ),
    ]


def cut_sentence(cut: Evaluations) -> str:
    """Result of one policy's episode, in words."""
    (result,) = cut.results
    numbers = {name: value.mean for name, value in result.overall.items()}
    whole = numbers["success"] == 1.0
    return (
        f"{'the whole ring was cut' if whole else 'the ring was not cut'} in "
        f"{numbers['time_s']:.0f} s, the beam's mean error was "
        f"{numbers['beam_error_mean_mm']:.3f} mm, the smallest clearance "
        f"{numbers['clearance_mm']:.0f} mm"
    )


def _error_pictures(drawn: list[Path]) -> list[Part]:
    """What step 3 shows: body, loops and error; the broad ones scroll on a narrow page."""
    by_name = {path.stem: path for path in drawn}
    return [
        Picture.from_file(by_name["body"], "Measured and predicted bodies"),
        Picture.from_file(
            by_name["loops"], "Loops, measured and predicted", "", BROAD_PX, drawn=True
        ),
        Picture.from_file(by_name["error"], "Error over the recording", "", BROAD_PX, drawn=True),
        Text("Details: `compare/report.html`; in 3-D: `surgisoft replay compare.rrd`"),
    ]


def _ranking_parts(found: Diagnosis) -> list[Part]:
    """What step 4 shows: chart and table of the ranked effects, as on the diagnosis' page."""
    page = diagnosis_page(found, "default")
    section = next((p for p in page.parts if isinstance(p, Section) and p.title == "Effects"), None)
    return [*(section.parts if section else ()), Text("Details: `diagnosis.html`")]
