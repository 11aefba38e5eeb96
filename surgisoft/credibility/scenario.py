"""A scenario: its states, how it goes in simulation and on the rig, and the agreement with FCL."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surgisoft.credibility.context import Scenario
from surgisoft.credibility.domain import States, rates, states_of
from surgisoft.credibility.metrics import COVERAGE_FACTOR, area_metric
from surgisoft.errors import InputError
from surgisoft.experiments.results import Results
from surgisoft.measurement.protocols.schedule_file import load_schedule
from surgisoft.measurement.recordings import load_recordings
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.mesh import Body, Mesh
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.tasks.episodes.file import load_episode
from surgisoft.tasks.episodes.log import EpisodeLog


@dataclass(frozen=True)
class Outcome:
    """A number of the scenario in simulation and on the rig, over episodes."""

    name: str
    """The number, with its unit."""
    simulated: str
    """Setting in simulation."""
    rig: str
    """Setting on the rig."""
    error: float
    """E: mean in simulation less mean on the rig."""
    uncertainty: float | None
    """U_val at 95 % from the scatter of the episodes; None for single episodes."""
    area: float
    """Area metric, in the unit of the number."""
    episodes: tuple[int, int]
    """Episodes of each."""


@dataclass(frozen=True)
class Agreement:
    """Batched geometry against the exact collision checker (FCL) on stored episodes."""

    episodes: int
    """Episodes that were checked."""
    instants: int
    """Instants at which contact was checked."""
    contact_differs: int
    """Instants at which only one of the two finds a contact."""
    clearance_off_mm: float
    """Largest difference of clearances where exact ones were computed, mm."""

    @property
    def sentence(self) -> str:
        """The agreement in words."""
        return (
            f"batched geometry and exact checker (FCL) differ about contact in "
            f"{self.contact_differs} of {self.instants} instants of {self.episodes} episodes, and "
            f"by at most {self.clearance_off_mm:.2g} mm in the least clearance"
        )


def stored_episodes(scenario: Scenario) -> dict[str, EpisodeLog]:
    """The episodes that the context names, alone or in folders of results, by their labels."""
    found: dict[str, EpisodeLog] = {}
    for text in scenario.states:
        path = Path(text)
        if path.is_dir() and (path / "logs").is_dir():
            logs = sorted((path / "logs").glob("[!.]*.npz"))  # hidden: left over by a kill
            if not logs:
                raise InputError(
                    f"{path}: the results hold no stored episode, expected logs/*.npz; run the "
                    "experiment again"
                )
            found |= {f"{path.name}/{log.stem}": load_episode(log) for log in logs}
        elif path.suffix == ".npz":
            found[path.stem] = load_episode(path)
    return found


def scenario_states(
    scenario: Scenario, spec: ArmSpec, episodes: Mapping[str, EpisodeLog]
) -> list[States]:
    """The states of every episode, recording and schedule of a scenario, for arms of this kind."""
    found = [states for label, log in episodes.items() for states in states_of_episode(log, label)]
    for text in scenario.states:
        path = Path(text)
        if path.suffix == ".npz" or (path.is_dir() and (path / "logs").is_dir()):
            continue
        if path.suffix == ".csv" and _is_schedule(path):
            protocol = load_schedule(path)
            t_s = protocol.t_s
            assert t_s is not None, "a schedule of a file has times"
            parts = [rates(t_s[run], protocol.commands[run]) for _, run in protocol.run_rows]
            rate = np.concatenate(parts)
            found.append(States(path.stem, protocol.commands, rate, None, None))
        else:
            measured = load_recordings([path], on_warning=_quiet)
            found += [states_of(each, spec.actuation) for each in measured]
    for states in found:
        if states.pressure.shape[1] != spec.chambers:
            raise InputError(
                f"scenario.states: {states.label} has {states.pressure.shape[1]} channels, "
                f"expected {spec.chambers} as the model has"
            )
    return [_loaded(states, scenario.payload_g) for states in found]


def _loaded(states: States, payload_g: Sequence[float]) -> States:
    """The states with the loads that the scenario states, dealt in turn over the rows."""
    if not payload_g:
        return states
    load = np.resize(np.array(payload_g, float), len(states.pressure))
    return States(states.label, states.pressure, states.rate, states.points_mm, load)


def _quiet(text: str) -> None:
    """Data-quality warnings of a scenario's recordings say nothing about a comparison."""


def _is_schedule(path: Path) -> bool:
    with path.open("rb") as file:
        header = file.readline(100_000).decode("utf-8", "replace")
    return "k0_" not in header


def states_of_episode(log: EpisodeLog, label: str) -> list[States]:
    """The states of each arm of an episode; key points in the arm's base frame."""
    found = []
    for name, arm in log.arms.items():
        turn, place = arm.mount[:3, :3], arm.mount[:3, 3]
        points = (arm.points_mm - place) @ turn
        rate = rates(log.time_s, arm.pressure_kPa)
        found.append(States(f"{label} {name}", arm.pressure_kPa, rate, points, None))
    return found


def agreement(logs: Iterable[EpisodeLog]) -> Agreement | None:
    """Check stored episodes again with FCL; None where there is nothing to touch.

    Contact at every instant, the exact clearance where the batched one is least.
    """
    instants = differs = 0
    off, episodes = 0.0, 0
    for log in logs:
        if not log.bodies or log.clearance_mm is None:
            continue
        episodes += 1
        bodies = [
            Body(body.name, body.role, Mesh(body.vertices_mm, body.faces)) for body in log.bodies
        ]
        checker = CollisionChecker(bodies)
        collided = log.measures.get("collided")
        batched = log.clearance_mm < 0.0 if collided is None else collided > 0.0
        for row in range(log.rows):
            found = checker.collisions(_shapes(log, row))
            differs += bool(found) != bool(batched[row])
        instants += log.rows
        closest = int(np.argmin(log.clearance_mm))
        exact = checker.clearance(_shapes(log, closest)).least_mm
        off = max(off, abs(exact - float(log.clearance_mm[closest])))
    return Agreement(episodes, instants, differs, off) if episodes else None


def _shapes(log: EpisodeLog, row: int) -> dict[str, ArmShape]:
    return {
        name: ArmShape(np.asarray(arm.line_mm[row], float), arm.radius_mm)
        for name, arm in log.arms.items()
    }


def outcomes(results: Results) -> list[Outcome]:
    """Simulation against rig: every pair of settings that differ in their plant alone."""
    cases = {case.name: case for case in results.experiment.cases}
    found = []
    for ours in results.settings:
        for theirs in results.settings:
            here, there = cases[ours.case], cases[theirs.case]
            if here.plant != "simulation" or there.plant != "rig":
                continue
            if (here.policy, here.arm, ours.values) != (there.policy, there.arm, theirs.values):
                continue
            for name, title in results.experiment.of.experiment.numbers.items():
                a, b = (_values(setting.rows, name) for setting in (ours, theirs))
                if len(a) and len(b):
                    found.append(_outcome(title, ours.label, theirs.label, a, b))
    return found


def _outcome(title: str, ours: str, theirs: str, a: np.ndarray, b: np.ndarray) -> Outcome:
    spread = None
    if len(a) > 1 and len(b) > 1:
        spread = COVERAGE_FACTOR * float(np.sqrt(a.var(ddof=1) / len(a) + b.var(ddof=1) / len(b)))
    error = float(a.mean() - b.mean())
    return Outcome(title, ours, theirs, error, spread, area_metric(a, b), (len(a), len(b)))


def _values(rows, name: str) -> np.ndarray:
    values = [row.get(name) for row in rows]
    return np.array([v for v in values if isinstance(v, int | float) and np.isfinite(v)], float)
