"""One episode of any task as numpy arrays: what replays draw and reports read.

A log has T rows: row 0 is the start, row k the state after k steps. World frame, mm, s, kPa. It
stands alone: the scene's bodies, the dose's triangles and the camera are in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from surgisoft.tasks.base import (
    DONE,
    TIME_OUT,
    Outcome,
    Task,
    TaskState,
    check_measures,
    trace_of,
)
from surgisoft.tasks.episodes.parts import (
    ArmLog,
    BeamLog,
    BodyLog,
    CameraLog,
    DoseLog,
    Event,
)
from surgisoft.tasks.world.arm import radius_mm
from surgisoft.tasks.world.respiration import MOVING
from surgisoft.tasks.world.scene import ObstacleEngine, SceneEngine

EARLY = "ended early"
"""Event at the end of an episode that ended before its time without success."""
JUMP_MM = 3.0
"""A target that moves farther than this in one step has jumped: no line is drawn (mm)."""


@dataclass(frozen=True, eq=False)
class EpisodeLog:
    """Log of one episode with T rows. What a task does not have is None or empty."""

    task: str
    """Name of the task in the registry."""
    agents: tuple[str, ...]
    """Names of the arms that acted."""
    policy: str
    """Name of the policy: `scripted`, `random`, or that of a learned one."""
    on: str
    """`simulation` or `rig`."""
    seed: int
    """Seed of the batch that the episode was part of."""
    episode: int
    """Number of the episode within that seed."""
    scene: str | None
    """Folder of the scene."""
    dt_s: float
    """Time of a step, s."""
    time_s: np.ndarray
    """(T,) s since the episode began."""
    arms: dict[str, ArmLog]
    """Each arm by name."""
    targets_mm: np.ndarray
    """(T, k, 3) mm: reference of the task's points; k is 1 but for tasks of a whole body."""
    actuals_mm: np.ndarray
    """(T, k, 3) mm: actual place of the task's points."""
    path_mm: np.ndarray
    """(M, 3) mm: the paths that are asked for; (0, 3) where there is none but the targets."""
    measures: dict[str, np.ndarray]
    """The task's measures: name with unit -> (T,); nan where one does not apply."""
    rewards: dict[str, dict[str, np.ndarray]]
    """agent -> reward term -> (T,); nan in row 0."""
    limits: dict[str, float]
    """The scene's limits: `clearance_mm`, `view_fraction`, `time_s`; empty without a scene."""
    beams: dict[str, BeamLog] = field(default_factory=dict)
    """Each laser's beam by the arm's name."""
    cameras: dict[str, CameraLog] = field(default_factory=dict)
    """Each endoscope's camera by the arm's name."""
    clearance_mm: np.ndarray | None = None
    """(T,) mm: least distance of any arm from a body or another arm."""
    views: dict[str, np.ndarray] = field(default_factory=dict)
    """Endoscope's name -> (T,) 0..1: share of the ring that it sees."""
    dose: DoseLog | None = None
    """Dose map of the organ around the ring."""
    bodies: tuple[BodyLog, ...] = ()
    """The bodies of the scene."""
    events: tuple[Event, ...] = ()
    """Events of the episode, in order of time."""
    path_starts: np.ndarray | None = None
    """(J,) int: number of the first point of each path in `path_mm`; None: one path."""
    path_closed: np.ndarray | None = None
    """(J,) bool: whether the last point of a path is followed by its first; None: it is."""

    @property
    def one_ring(self) -> bool:
        """Whether one closed path is asked for."""
        return self.path_closed is None or self.path_closed.tolist() == [True]

    @property
    def paths_mm(self) -> list[np.ndarray]:
        """The paths that are asked for, (N, 3) mm each; of a closed one the first point is last."""
        starts = [0] if self.path_starts is None else self.path_starts.tolist()
        closed = [True] * len(starts) if self.path_closed is None else self.path_closed.tolist()
        pieces = np.split(self.path_mm, starts[1:])
        return [
            np.vstack((piece, piece[:1])) if back else piece
            for piece, back in zip(pieces, closed, strict=True)
            if len(piece)
        ]

    def body(self, name: str) -> BodyLog:
        """The body of that name."""
        return next(body for body in self.bodies if body.name == name)

    @property
    def organ_motion(self) -> np.ndarray | None:
        """(T, 4, 4): motion of the organ with the dose, see `BodyLog`; None where it stays."""
        return None if self.dose is None else self.body(self.dose.body).motion

    def at_rest_mm(self, points_mm: np.ndarray) -> np.ndarray:
        """(T, 3) mm: points of each row on the organ, where they lie while it is at rest."""
        motion = self.organ_motion
        if motion is None:
            return points_mm
        inward = np.linalg.inv(motion.astype(float))
        return np.einsum("tij,tj->ti", inward[:, :3, :3], points_mm) + inward[:, :3, 3]

    @property
    def rows(self) -> int:
        """Number T of rows."""
        return len(self.time_s)

    @property
    def beam(self) -> BeamLog | None:
        """The beam of the first laser; None without one."""
        return next(iter(self.beams.values()), None)

    @property
    def camera(self) -> CameraLog | None:
        """The camera of the first endoscope; None without one."""
        return next(iter(self.cameras.values()), None)

    @property
    def view_fraction(self) -> np.ndarray | None:
        """(T,) 0..1: share of the ring that the first endoscope sees; None without one."""
        return next(iter(self.views.values()), None)

    @property
    def burning(self) -> np.ndarray | None:
        """(T,) bool: some beam burnt in the step before; None without a laser."""
        on = [beam.on for beam in self.beams.values()]
        return np.any(on, axis=0) if on else None

    @property
    def target_mm(self) -> np.ndarray:
        """(T, 3) mm: reference of the task's point (of a whole body the tip)."""
        return self.targets_mm[:, -1]

    @property
    def actual_mm(self) -> np.ndarray:
        """(T, 3) mm: actual place of the task's point (of a whole body the tip)."""
        return self.actuals_mm[:, -1]

    @property
    def error_mm(self) -> np.ndarray:
        """(T,) mm: mean distance of the task's points from their references."""
        return np.linalg.norm(self.targets_mm - self.actuals_mm, axis=-1).mean(axis=1)


class EpisodeRecorder:
    """Records the log of one episode of a running batch; copies all that it stores.

    Built on the state in which the episode starts; `step` after each step; then `log`. Steps after
    the episode's end are left out, so a batch may run on.
    """

    def __init__(
        self,
        task: Task,
        state: TaskState,
        environment: int = 0,
        *,
        policy: str,
        seed: int,
        episode: int | None = None,
        on: str = "simulation",
    ):
        """`environment` is the episode's row of the batch, `episode` its number in the seed.

        Without `episode` they are the same.
        """
        self.task, self.done, self.environment = task, False, environment
        self._about: dict[str, Any] = {"policy": policy, "seed": int(seed), "on": on}
        self._about["episode"] = environment if episode is None else int(episode)
        self._rows: list[dict[str, np.ndarray]] = []
        self._dose: list[tuple[np.ndarray, np.ndarray]] = []
        self._last_dose: np.ndarray | None = None
        self._mounts = {name: self._of(part.mount) for name, part in state.world.arms.items()}
        lesion = state.world.scene.lesion
        self._lesion = 0 if lesion is None else int(self._of(lesion))
        self._ending = ""
        measures = task.measures(state)
        check_measures(task, measures, len(state.world.failed))
        self._add(state, measures, {}, {})

    def step(
        self,
        state: TaskState,
        outcome: Outcome,
        actions: Mapping[str, Tensor],
        environment: int | None = None,
    ) -> None:
        """The state that a step came to, before any reset, and the actions that led there.

        `environment` is given where the episode's row of the batch has changed.
        """
        if self.done:
            return
        self.environment = self.environment if environment is None else environment
        self._add(state, outcome.measures, actions, outcome.terms)
        self.done = bool(self._of(outcome.done))
        if bool(self._of(state.world.failed)):
            self._ending = "failed"
        elif self.done:
            self._ending = "ended" if bool(self._of(outcome.terminated)) else TIME_OUT

    def log(self) -> EpisodeLog:
        """The episode so far."""
        task, config = self.task, self.task.world.config
        scene = getattr(getattr(task, "config", None), "scene", None)
        around = task.world.scene
        near = around if isinstance(around, SceneEngine) else None
        rows = {name: self._column(name) for name in self._rows[-1]}
        log = EpisodeLog(
            task=task.name,
            agents=tuple(task.agents),
            **self._about,
            scene=None if scene is None else str(scene),
            dt_s=config.dt_s,
            time_s=config.dt_s * np.arange(len(self._rows)),
            arms={name: self._arm(name, rows) for name in task.world.arms},
            targets_mm=rows["targets"],
            actuals_mm=rows["actuals"],
            **self._paths(near),
            measures=_below(rows, "measures/"),
            rewards={agent: _below(rows, f"rewards/{agent}/") for agent in task.agents},
            limits={} if near is None else _limits(near) | self._stricter(),
        )
        if near is not None:
            log = replace(log, **self._scene_fields(near, rows))
        elif isinstance(around, ObstacleEngine):
            bodies = tuple(_body(body) for body in around.geometry.bodies)
            limits = {"clearance_mm": around.clearance_mm} | self._stricter()
            log = replace(log, bodies=bodies, limits=limits, clearance_mm=rows["clearance"])
        return replace(log, events=find_events(log, self._ending))

    def _stricter(self) -> dict[str, float]:
        """The limit of clearance of an experiment's phases, which holds in place of the scene's."""
        clear_mm = getattr(self.task, "clear_mm", None)
        return {} if clear_mm is None else {"clearance_mm": float(clear_mm)}

    def _of(self, tensor: Tensor) -> np.ndarray:
        """A copy of the recorded environment's row of a tensor."""
        return tensor[self.environment].detach().cpu().numpy().copy()

    def _add(self, state: TaskState, measures, actions, terms) -> None:
        targets, actuals = trace_of(self.task, state)
        row = {"targets": targets, "actuals": actuals}
        for name, part in state.world.arms.items():
            row |= {f"{name}/{field}": getattr(part, field) for field in _ARM_ROWS}
        row |= {f"{name}/action": action for name, action in actions.items()}
        row |= {f"measures/{name}": value for name, value in measures.items()}
        for agent, parts in terms.items():
            row |= {f"rewards/{agent}/{term}": value for term, value in parts.items()}
        near = state.world.scene
        if near.clearance is not None:
            row["clearance"] = near.clearance.least_mm
        for name, hit in near.hits.items():
            row |= {f"end/{name}": hit.point_mm, f"hits/{name}": hit.on_organ}
        row |= {f"view/{name}": view.fraction for name, view in near.views.items()}
        around = self.task.world.scene
        if isinstance(around, SceneEngine):
            placement = around.placement(near.breaths)
            row |= {} if placement is None else {"motion": placement.map.float()}
        if near.dose is not None:
            joules = near.dose.delivered_j
            each = joules.reshape(len(joules), -1).unbind(1)
            row |= {f"delivered/{n}": j for n, j in zip(near.hits, each, strict=True)}
            self._add_dose(self._of(near.dose.dose))
        self._rows.append({name: self._of(value) for name, value in row.items()})

    def _add_dose(self, dose: np.ndarray) -> None:
        last = np.zeros_like(dose) if self._last_dose is None else self._last_dose
        changed = np.flatnonzero(dose != last).astype(np.int32)
        self._dose.append((changed, dose[changed]))
        self._last_dose = dose

    def _column(self, name: str) -> np.ndarray:
        """All rows of one value; nan in row 0 for what only a step brings."""
        values = [row[name] for row in self._rows if name in row]
        missing = len(self._rows) - len(values)
        return np.stack([np.full_like(values[0], np.nan)] * missing + values)

    def _arm(self, name: str, rows: Mapping[str, np.ndarray]) -> ArmLog:
        world, arm = self.task.world, self.task.world.arms[name]
        if world.scene is not None:
            radius = world.scene.geometry.radius_mm(name)
        else:
            radius = radius_mm(arm.model)
        pressure = rows[f"{name}/pressure"]
        return ArmLog(
            command_kPa=rows[f"{name}/command"],
            pressure_kPa=pressure,
            action_kPa=rows.get(f"{name}/action", np.full_like(pressure, np.nan)),
            **{field: rows[f"{name}/{field}"] for field in _ARM_ROWS[2:]},
            mount=self._mounts[name],
            radius_mm=float(radius),
            shaft_mm=float(-arm.shaft[0, 2]) if len(arm.shaft) else 0.0,
            tool=self._tool(name),
        )

    def _tool(self, name: str) -> str:
        """The tool of an arm; empty without a scene."""
        around = self.task.world.scene
        return around.spec.mount(name).tool if isinstance(around, SceneEngine) else ""

    def _scene_fields(self, near: SceneEngine, rows: Mapping[str, np.ndarray]) -> dict:
        """The log's fields that only a scene has."""
        nearest, farthest = map(float, near.camera.range_mm)
        camera = CameraLog(near.camera.fov_rad, (nearest, farthest))
        return {
            "beams": {name: self._beam_log(name, rows) for name in near.lasers},
            "cameras": dict.fromkeys(near.endoscopes, camera),
            "clearance_mm": rows["clearance"],
            "views": _below(rows, "view/"),
            "dose": self._dose_log(near) if near.lasers else None,
            "bodies": tuple(
                _body(body, rows.get("motion") if body.role in MOVING else None)
                for body in near.geometry.bodies
            ),
        }

    def _beam_log(self, name: str, rows: Mapping[str, np.ndarray]) -> BeamLog:
        """The beam of one laser."""
        delivered = rows[f"delivered/{name}"]
        burnt = np.diff(delivered, prepend=delivered[:1])
        power = burnt / self.task.world.config.dt_s
        return BeamLog(power, rows[f"end/{name}"], rows[f"hits/{name}"])

    def _paths(self, near: SceneEngine | None) -> dict[str, Any]:
        """The paths of this episode's lesion, as fields of the log."""
        if near is None:
            return {"path_mm": np.zeros((0, 3), np.float32)}
        return {
            "path_mm": near.paths_mm[self._lesion].detach().cpu().numpy().copy(),
            "path_starts": np.array([each.first for each in near.stretches]),
            "path_closed": np.array([each.closed for each in near.stretches]),
        }

    def _dose_log(self, near: SceneEngine) -> DoseLog:
        ablation, patch = near.ablation, near.ablation.patches[self._lesion]
        counts = np.array([len(sample) for sample, _ in self._dose])
        rows = np.flatnonzero(counts)
        samples, doses = zip(*self._dose, strict=True)
        return DoseLog(
            body=near.geometry.bodies[near.organ].name,
            points_mm=patch.points_mm.astype(np.float32),
            normals=patch.normals.astype(np.float32),
            areas_mm2=patch.areas_mm2.astype(np.float32),
            faces=patch.faces.astype(np.int32),
            offset_mm=patch.offset_mm.astype(np.float32),
            station=patch.station.astype(np.int32),
            zone=patch.zone,
            stations=patch.stations,
            ring_length_mm=patch.ring_length_mm,
            threshold_j_per_mm2=float(ablation.threshold),
            cut_j_per_mm2=float(ablation.cut_dose),
            rows=rows,
            starts=np.concatenate(([0], np.cumsum(counts[rows]))),
            sample=np.concatenate(samples),
            dose_j_per_mm2=np.concatenate(doses),
        )


_ARM_ROWS = ("command", "pressure", "points_mm", "seen_mm", "line_mm", "tip_direction")
"""Fields of an `ArmPart` that every row stores."""


def _below(rows: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The values whose names begin so, by the rest of their names."""
    return {name[len(prefix) :]: value for name, value in rows.items() if name.startswith(prefix)}


def _limits(near: SceneEngine) -> dict[str, float]:
    limits = near.spec.limits
    return {name: float(getattr(limits, name)) for name in vars(limits)}


def _body(body, motion: np.ndarray | None = None) -> BodyLog:
    mesh = body.world_mesh
    vertices, faces = mesh.vertices_mm.astype(np.float32), mesh.faces.astype(np.int32)
    return BodyLog(body.name, body.role, vertices, faces, motion)


if TYPE_CHECKING:
    from surgisoft.tasks.episodes.log import EpisodeLog


def find_events(log: EpisodeLog, ending: str = "") -> tuple[Event, ...]:
    """Beam on and off, lesion in and out of sight, too close, contact, cut, and the end.

    `ending` is how the recorder saw it end: `ended` by the task, `time out`, `failed`, or "" where
    it was still running.
    """
    found: list[Event] = []
    found.append(Event(0.0, "info", f"{log.task} by {log.policy} in {log.on}, seed {log.seed}"))
    for name, beam in log.beams.items():
        whose = f" of {name}" if len(log.beams) > 1 else ""
        words = ("info", f"beam{whose} on"), ("info", f"beam{whose} off")
        found += _changes(log, beam.on, *words)
    for name, view in log.views.items():
        seen = view >= log.limits["view_fraction"]
        by = f" by {name}" if len(log.views) > 1 else ""
        words = ("info", f"lesion in sight{by}"), ("warning", f"lesion lost{by}")
        found += _changes(log, seen, *words)
    if log.clearance_mm is not None:
        if "clearance_mm" in log.limits:
            least = log.limits["clearance_mm"]
            close = ("warning", f"closer than {least:g} mm"), ("info", f"{least:g} mm clear again")
            found += _changes(log, log.clearance_mm < least, *close)
        found += _changes(
            log, log.clearance_mm < 0.0, ("error", "contact"), ("info", "contact ended")
        )
    collided = log.measures.get("collided")
    if collided is not None and log.clearance_mm is not None:
        folded = (collided > 0.0) & ~(log.clearance_mm < 0.0)
        found += _changes(log, folded, ("error", "an arm touches itself"), ("info", "arm unfolded"))
    completion = log.measures.get("completion")
    if completion is not None and len(whole := np.flatnonzero(completion >= 1.0)):
        text = "ring cut all around" if log.one_ring else "all is treated"
        found.append(Event(float(log.time_s[whole[0]]), "info", text))
    if ending:
        found.append(Event(float(log.time_s[-1]), *_end(log, ending)))
    return tuple(sorted(found, key=lambda event: event.time_s))


def _changes(
    log: EpisodeLog, holds: np.ndarray, begins: tuple[str, str], ends: tuple[str, str]
) -> list[Event]:
    """An event wherever (T,) bool `holds` changes; not holding at the start is no event."""
    before = np.concatenate(([False], holds[:-1]))
    return [
        Event(float(log.time_s[row]), *(begins if holds[row] else ends))
        for row in np.flatnonzero(holds != before)
    ]


def _end(log: EpisodeLog, ending: str) -> tuple[str, str]:
    """Level and text of the episode's end."""
    if ending == "failed":
        return "error", "an arm is no longer finite"
    success = log.measures.get("success")
    if success is None or success[-1] > 0.0:
        return "info", DONE
    return ("warning", "the time has elapsed") if ending == TIME_OUT else ("error", EARLY)
