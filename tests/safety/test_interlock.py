"""The interlock as a property: whatever policies do, the beam is never on where it must not be."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from benchmarks.interlock import TIGHT_MM, Audit, attack, laser_tasks, varied
from surgisoft.agents.on_rig import RigConfig, on_rig
from surgisoft.errors import InputError
from surgisoft.experiments.phases import RUNNING, PhasedTask
from surgisoft.experiments.spec import load_experiment
from surgisoft.rig import SafeRig, VirtualRig
from surgisoft.rig.safety import RigStopped, Safety
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.breathing_ablation import BreathingAblation, BreathingAblationConfig
from surgisoft.tasks.keyhole_ablation import KeyholeAblation, KeyholeAblationConfig
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.registry import TASKS
from surgisoft.tasks.track import TrackConfig, track_circle
from surgisoft.tasks.world.respiration import Breaths
from tests.experiments.tiny import TINY, write

RIG = RigConfig(seed=1, settle_s=0.2)


@dataclass(frozen=True)
class Attack:
    """How a task is attacked for as short as its beam is on at times."""

    clearance_mm: float = TIGHT_MM
    """Limit of the clearance, which the expert just keeps, mm."""
    warm: int = 24
    """Steps in which all arms follow the expert at first."""
    steps: int = 8
    """Steps under adversaries."""
    seed: int = 1
    """Seed of episodes and adversaries."""
    fields: Mapping[str, float] = field(default_factory=dict)
    """Fields of the task's config."""


ATTACKS = {
    "contour_ablation": Attack(clearance_mm=27.0),
    "area_ablation": Attack(clearance_mm=25.5, seed=3),
    "keyhole_ablation": Attack(1.5, 42, fields={"speed_mm_s": 80.0, "wait_s": 0.5}),
    "two_laser_ring": Attack(15.0, 14),
}
"""Around contours the expert keeps more than 24 mm. Arms that enter through ports are fed in
quickly, and are never 24 mm from the wall; two lasers and an endoscope around one ring are nearer
to each other than one laser and an endoscope."""


ON_RIG = {
    "circle_ablation": Attack(25.5, steps=12, seed=3),
    "contour_ablation": Attack(25.5, steps=12, seed=3),
    "area_ablation": Attack(25.5, steps=12, seed=3),
    "breathing_ablation": Attack(25.0, steps=16, seed=2),
    "keyhole_ablation": replace(ATTACKS["keyhole_ablation"], clearance_mm=1.2, steps=16, seed=3),
    "two_laser_ring": Attack(16.0, 14, 16, seed=3),
}
"""The same on virtual rigs: limits and seeds with which two episodes have steps in which the
clearance alone keeps the beam off, and others in which sight alone does."""


def attacked(name, attacks=ATTACKS):
    """A task with late actions, noise and displaced mounts, and how it is attacked."""
    how = attacks.get(name, Attack())
    return varied(name, clearance_mm=how.clearance_mm, **how.fields), how


@pytest.mark.parametrize("name", laser_tasks())
def test_no_policy_turns_the_beam_on_where_it_must_be_off(name):
    """Twenty episodes of every task with a laser in simulation."""
    task, how = attacked(name)
    found = attack(task, 20, how.warm + how.steps, seed=how.seed, warm=how.warm)
    assert found.broken == []
    assert found.fired > 10, "the beam has to be on at times, or nothing is tested"
    for reason in ("too close", "off the path"):
        assert found.alone[reason] > 0, reason
    assert found.unsafe["out of sight"] > 0


@pytest.mark.parametrize("name", laser_tasks())
def test_no_policy_turns_the_beam_on_where_it_must_be_off_on_the_rig(name):
    """Two episodes of each on virtual rigs, whose arms are known from their cameras alone."""
    task, how = attacked(name, ON_RIG)
    moved = on_rig(task, RIG)
    found = attack(moved, 2, how.warm + how.steps, seed=how.seed, without=("NaN",), warm=how.warm)
    assert found.broken == []
    assert found.fired > 5
    for reason in ("out of sight", "too close"):
        assert found.alone[reason] > 0, reason
    assert found.unsafe["off the path"] > 0


@pytest.fixture(scope="module")
def phased(tmp_path_factory):
    """A circle ablation in two phases, of which the second permits the beam."""
    text = TINY.replace("time_s = 0.5", f"time_s = 9.0\nclearance_mm = {TIGHT_MM}")
    spec = load_experiment(write(tmp_path_factory.mktemp("spec"), text))
    base = varied("circle_ablation")
    return PhasedTask(TASKS[base.name].experiment.supervise(base), spec), base, spec


def test_an_experiments_limit_holds_in_all_its_phases(phased):
    task, base, spec = phased
    audit = Audit(base, clearance_mm=spec.limits.clearance_mm)
    found = attack(task, 20, 32, seed=1, warm=24, audit=audit, base=base)
    assert found.broken == []
    assert found.fired > 10
    assert found.unsafe["too close"] > 5


class Drawn:
    """A supervision whose answers are drawn; keeps whether the beam was let on."""

    def __init__(self, base, sight, clearance, collides, fires):
        self.task, self.clearance_limit_mm = base, 1.0
        self.answers = sight, clearance, collides, fires
        self.let_on = None

    def in_sight(self, state):
        return self.answers[0]

    def clearance_mm(self, state):
        return self.answers[1]

    def collides(self, state):
        return self.answers[2]

    def fires(self, state):
        return self.answers[3]

    def fired(self, state):
        return state.goal.fired

    def advance(self, state, actions, fired):
        self.let_on = fired
        return state


GOOD = {
    "sight": True,
    "clearance": 25.0,
    "collides": False,
    "fires": True,
    "phase": 1,
    "reason": RUNNING,
    "failed": False,
}
"""A state in which the beam may be on."""
BAD = {
    "sight": st.just(False),
    "clearance": st.one_of(
        st.sampled_from([TIGHT_MM - 1e-3, 1.0, 0.0, -5.0, math.nan, -math.inf]),
        st.floats(-5.0, TIGHT_MM - 1e-3),
    ),
    "collides": st.just(True),
    "fires": st.just(False),
    "phase": st.sampled_from([0, 2]),
    "reason": st.sampled_from([1, 2, 3]),
    "failed": st.just(True),
}
"""For each condition what keeps the beam off, whatever the others are."""
ROW = st.sets(st.sampled_from(sorted(BAD)), max_size=2).flatmap(
    lambda names: st.fixed_dictionaries({name: BAD[name] for name in names})
)


@pytest.fixture(scope="module")
def start(phased):
    return Episodes(phased[0]).seeded(0, 4)


@settings(deadline=None)
@example(flaws=[{}, {"sight": False}, {"collides": True}, {"failed": True}], room=0.0)
@example(flaws=[{}, {"clearance": math.nan}, {"fires": False}, {"reason": 1}], room=0.0)
@given(flaws=st.lists(ROW, min_size=4, max_size=4), room=st.floats(0.0, 100.0))
def test_the_beam_needs_every_condition_at_once(phased, start, flaws, room):
    """Phase, no abort, sight, clearance, no contact, finite arms, and the task itself."""
    _, base, spec = phased
    drawn = [GOOD | {"clearance": TIGHT_MM + room} | flaw for flaw in flaws]
    column = {name: torch.tensor([row[name] for row in drawn]) for name in GOOD}
    names = ("sight", "clearance", "collides", "fires")
    supervision = Drawn(base, *(column[name] for name in names))
    task = PhasedTask(supervision, spec)
    goal = replace(start.goal, phase=column["phase"], reason=column["reason"])
    world = replace(start.world, failed=column["failed"])
    task.advance(replace(start, goal=goal, world=world), {})
    assert supervision.let_on.tolist() == [not flaw for flaw in flaws]


class GatedDrawn(BreathingAblation):
    """The beam in the gate, with an answer of `released` that is drawn."""

    def released(self, state):
        """(B,) bool: what was drawn."""
        return self.drawn


class FedDrawn(KeyholeAblation):
    """The beam of arms that are fed in, with an answer of `released` that is drawn."""

    def released(self, state):
        """(B,) bool: what was drawn."""
        return self.drawn


GATE_MM = 1.5


@pytest.fixture(scope="module")
def gated():
    task = GatedDrawn(BreathingAblationConfig(mode="gated", gate_mm=GATE_MM))
    return task, Episodes(task).seeded(0, 1)


@pytest.fixture(scope="module")
def fed():
    task = FedDrawn(KeyholeAblationConfig())
    return task, Episodes(task).seeded(0, 1)


BREATH = st.fixed_dictionaries(
    {
        "amplitude": st.floats(1.0, 25.0),
        "period": st.floats(1.5, 8.0),
        "at": st.floats(0.0, 0.999),
        "released": st.booleans(),
    }
)
"""A breath (mm, s), what share of it has passed, and whether all else releases the beam."""


@settings(deadline=None)
@example(breaths=[{"amplitude": 12.0, "period": 4.0, "at": 0.5, "released": True}])
@example(breaths=[{"amplitude": 12.0, "period": 4.0, "at": 0.0, "released": True}])
@given(breaths=st.lists(BREATH, min_size=1, max_size=8))
def test_the_beam_is_never_on_outside_of_the_gate(gated, breaths):
    """Lujan's law from the end of exhalation: b sin^2n(pi t / tau) within gate_mm, or no beam."""
    task, state = gated
    column = {name: torch.tensor([each[name] for each in breaths]) for name in breaths[0]}
    amplitude, period, at = (column[name] for name in ("amplitude", "period", "at"))
    breath = Breaths(0.0 * period[:, None], period[:, None], amplitude[:, None], at * period)
    scene = replace(state.world.scene, breaths=breath)
    task.drawn = released = column["released"]
    on = task.fires(replace(state, world=replace(state.world, scene=scene)))
    n = task.config.respiration.asymmetry
    moved_mm = amplitude.double() * (math.pi * at.double()).sin() ** (2 * n)
    assert not on[moved_mm > GATE_MM + 1e-3].any()
    assert not on[~released].any()
    assert on[released & (moved_mm < GATE_MM - 1e-3)].all()


OUT_MM = st.one_of(st.sampled_from([0.0, 1e-6, 80.0, math.nan]), st.floats(0.0, 200.0, width=32))
"""Distance of the carriages behind their mounts, mm."""


@settings(deadline=None)
@example(arms=[(0.0, True), (1e-6, True), (math.nan, True), (0.0, False)])
@given(arms=st.lists(st.tuples(OUT_MM, st.booleans()), min_size=1, max_size=8))
def test_the_beam_is_never_on_while_the_arms_are_fed_in(fed, arms):
    task, state = fed
    task.drawn = torch.tensor([released for _, released in arms])
    out_mm = torch.tensor([out for out, _ in arms])
    on = task.fires(replace(state, world=replace(state.world, out_mm=out_mm)))
    assert on.tolist() == [released and out == 0.0 for out, released in arms]


def test_a_command_that_is_no_number_ends_an_episode_with_the_beam_off():
    task = varied("circle_ablation")
    episodes = Episodes(task)
    state = episodes.seeded(0, 2)
    bad = {name: torch.zeros(2, 3) for name in task.agents}
    bad["laser"][0, 1] = math.nan
    state, outcome = episodes.step(state, bad)
    assert outcome.terminated.tolist() == [True, False]
    assert not task.fires(state)[0]
    after, _ = episodes.step(state, {name: torch.zeros(2, 3) for name in task.agents})
    assert not after.goal.fired[0]
    assert float(after.world.scene.dose.delivered_j[0]) == 0.0


class Bench:
    """A real bench as far as anyone can tell: a simulated arm, and what its valves were sent."""

    def __init__(self):
        self.inner = VirtualRig(0)
        for name in ("unit", "chambers", "key_planes", "limits", "period_s", "arm", "payload_g"):
            setattr(self, name, getattr(self.inner, name))
        self.gravity = self.inner.gravity
        self.sent, self.vents = [], 0

    def reset(self):
        self.inner.reset()

    def command(self, pressures):
        self.sent.append((self.inner.time_s, np.array(pressures)))
        self.inner.command(pressures)

    def wait(self, seconds):
        self.inner.wait(seconds)

    def read(self):
        return self.inner.read()

    def vent(self):
        self.vents += 1


BRIEF = TrackConfig(FollowConfig(loop_s=2.0, approach_s=1.0))
SHAPES = {
    "random": lambda rng, shape: rng.uniform(-3.0, 3.0, shape),
    "one end": lambda rng, shape: np.full(shape, 100.0),
    "back and forth": lambda rng, shape: rng.choice([-100.0, 100.0], shape),
    "1e30": lambda rng, shape: rng.choice([-1e30, 1e30], shape),
    "infinite": lambda rng, shape: rng.choice([-np.inf, np.inf], shape),
    "NaN": lambda rng, shape: np.where(rng.random(shape) < 0.3, np.nan, 1.0),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_pressure_and_rate_on_a_real_bench_keep_their_limits(shape):
    """A policy of a task through the safety wrapper; NaN ends the run vented."""
    bench, safety = Bench(), Safety(lowest=-8.0, highest=30.0, rate=40.0)
    moved = on_rig(
        track_circle(BRIEF), RigConfig(settle_s=0.2), lambda config, trial: SafeRig(bench, safety)
    )
    (arm,) = moved.world.arms.values()
    rng, episodes = np.random.default_rng(0), Episodes(moved)

    def drive():
        with arm.real:
            state = episodes.seeded(0, 1)
            for _ in range(25):
                action = torch.tensor(SHAPES[shape](rng, (1, 3)), dtype=torch.float32)
                state, _ = episodes.step(state, {"arm": action})

    if shape == "NaN":
        with pytest.raises(RigStopped, match="no valid command for"):
            drive()
    else:
        drive()
    assert bench.vents >= 1
    values = np.array([pressures for _, pressures in bench.sent])
    times = np.array([time for time, _ in bench.sent])
    assert np.isfinite(values).all()
    assert values.min() >= -8.0
    assert values.max() <= 30.0
    # 40 kPa/s over any stretch, and one period's worth at its begin.
    for ahead in (1, 5, 20):
        moved_kPa = np.abs(values[ahead:] - values[:-ahead]).max(1)
        passed = times[ahead:] - times[:-ahead]
        assert (moved_kPa <= 40.0 * (passed + 2 * bench.period_s) + 1e-6).all()


def test_a_command_that_is_no_number_never_reaches_the_virtual_rig():
    moved = on_rig(track_circle(BRIEF), RigConfig(settle_s=0.2))
    state = Episodes(moved).seeded(0, 1)
    with pytest.raises(InputError, match="expected 3 finite pressures in kPa"):
        Episodes(moved).step(state, {"arm": torch.full((1, 3), math.nan)})
