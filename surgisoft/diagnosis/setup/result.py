"""The set-up tests of a diagnosis: faults that are no physics, and how to correct them."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from surgisoft.diagnosis.other_models import body_lengths, has_slope, is_of_other_origin
from surgisoft.diagnosis.residuals import (
    EVERY_ROW,
    fit_of_model,
    floor_to_tell,
    model_discrepancy,
    noise_of,
)
from surgisoft.diagnosis.setup.alignment import HANDED, Frame, angle, shifted
from surgisoft.diagnosis.setup.arrangements import mistaken
from surgisoft.diagnosis.setup.blind import Blind, blind_channel
from surgisoft.diagnosis.setup.channels import Dead, dead_channels
from surgisoft.diagnosis.setup.correction import Correction
from surgisoft.diagnosis.setup.mixed_units import MixedUnits, mixed_units
from surgisoft.diagnosis.setup.sample import Arrangement, sample_of, samples_of
from surgisoft.diagnosis.setup.search import (
    PROOF,
    SETTINGS,
    Fitted,
    Found,
    Hypothesis,
    Levels,
    Search,
)
from surgisoft.diagnosis.setup.words import (
    SetupFault,
    faults_of,
    frame_fault,
    joined,
    model_in_other_unit,
    signed_axes,
    time_unit_fault,
)
from surgisoft.files import with_former_keys
from surgisoft.measurement.histories import actuation_of, check_fits, tied_channels
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.model import ArmModel

EXACT_RAD = 0.09
"""A frame is one whose axes were swapped or mirrored, and nothing else, up to this turn beside it:
5 degrees."""
LEAST_MOTION = 0.05
"""A key point that stands still is dead if it should move by this share of the one that moves
most."""
WHOLE = 0.95
"""A key point is dead, not frozen for a while, from this share of the rows on."""
FORMER_KEYS = {
    "mending": "instructions",
    "alternative_mendings": "alternative_instructions",
    "mendable": "correctable",
}
"""Deprecated keys of the JSON, each with its present name."""
MOST_APART = 8
"""Most recordings that are tested one by one where they share no fault."""
SLOW_OR_WRONG = (
    "the model hardly depends on time, so the time between rows alone says this: compare the "
    'recording\'s length with a watch; if it is right, state kind = "settled" in the sidecar for '
    "steady-state samples, or leave out the set-up tests (--no-setup-tests)"
)
"""How to find out whether times are in another unit, where the model does not say so."""


@dataclass(frozen=True)
class SetupResult:
    """Faults in the set-up of some recordings."""

    faults: tuple[SetupFault, ...]
    """The faults; all of them hold together."""
    alternatives: tuple[tuple[SetupFault, ...], ...]
    """Other explanations that do as well, each with the faults that it consists of."""
    sentence: str
    """What is wrong, and what the correction does to the error."""
    instructions: str
    """Lines of the import's map that correct it, or what else to do."""
    alternative_instructions: tuple[str, ...]
    """The same for each of the alternatives."""
    how_to_tell: str
    """How to find out which explanation is right; empty where there is one."""
    before_mm: float
    """RMS error of the model as recorded, mm."""
    after_mm: float
    """RMS error with the correction, mm."""
    floor_mm: float
    """Noise floor, mm."""
    recordings: tuple[str, ...]
    """Names of the recordings that it holds for; their files where several have one name."""
    correctable: bool
    """Whether the recordings can be corrected without recording again."""
    correction: Correction
    """The correction of a recording."""
    of_model: str = ""
    """How the model may be wrong in place of the recordings; empty where it is not."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of the faults."""
        return tuple(fault.kind for fault in self.faults)

    def corrected(self, recordings: Sequence[Recording]) -> list[Recording]:
        """The recordings; those that have the faults are corrected."""
        return [
            self.correction.applied(recording) if name in self.recordings else recording
            for recording, name in zip(recordings, _called(recordings), strict=True)
        ]

    def to_json(self) -> dict[str, Any]:
        """Plain values, for `diagnose --json`.

        `mending`, `alternative_mendings` and `mendable` are deprecated names of `instructions`,
        `alternative_instructions` and `correctable`.
        """
        plain = {
            "faults": [asdict(fault) for fault in self.faults],
            "alternatives": [[asdict(fault) for fault in some] for some in self.alternatives],
            "sentence": self.sentence,
            "instructions": self.instructions,
            "alternative_instructions": list(self.alternative_instructions),
            "how_to_tell": self.how_to_tell,
            "of_model": self.of_model,
            "before_mm": self.before_mm,
            "after_mm": self.after_mm,
            "floor_mm": self.floor_mm,
            "recordings": list(self.recordings),
            "correctable": self.correctable,
        }
        return with_former_keys(plain, FORMER_KEYS)


def find_setup_faults(model: ArmModel, recordings: Sequence[Recording]) -> SetupResult | None:
    """The faults of the set-up that recordings of a model's arm show; None where none is proved.

    All recordings are tested together first. Where they share no fault, each is tested alone: one
    of several may have been recorded after a camera was moved. Nothing is proved by a model whose
    change with the actuation is not known. Raises InputError for recordings of another arm.
    """
    check_fits(model.spec, list(recordings), sized=False)
    if not has_slope(model):
        return None
    measured = [r for r in recordings if np.isfinite(r.key_points_mm).any()]
    if not measured:
        return None
    called = {id(r): name for r, name in zip(recordings, _called(recordings), strict=True)}

    def named(result: SetupResult, some: list[Recording]) -> SetupResult:
        return replace(result, recordings=tuple(called[id(each)] for each in some))

    found = _of_one_setup(model, measured)
    if found is not None:
        return named(found, measured)
    if len(measured) == 1:
        return None
    results = [(each, _of_one_setup(model, [each])) for each in measured[:MOST_APART]]
    alone = [(each, result) for each, result in results if result is not None]
    if not alone:
        return None
    one, first = alone[0]
    same = [each for each, result in alone if result.kinds == first.kinds]
    together = _of_one_setup(model, same) if same[1:] else first
    return named(together, same) if together else named(first, [one])


def find_small_frame(
    model: ArmModel, recordings: Sequence[Recording]
) -> tuple[SetupFault, float] | None:
    """A small change of the frame that explains the error of a model, and what it leaves [mm].

    It is within the plausible range of the effect `misalignment`, so that it is no set-up fault:
    `diagnose` tells it from the other effects. None where it explains less than a fault has to.
    """
    measured = [r for r in recordings if np.isfinite(r.key_points_mm).any()]
    if not measured or not has_slope(model):
        return None
    search = _search(model, measured, _levels(model, measured))
    start = search.start
    if start.hypothesis.frame != "small" or not search.explains(search.raw.rmse_mm, start.rmse_mm):
        return None
    return frame_fault(start, start.frame), start.rmse_mm


def _called(recordings: Sequence[Recording]) -> list[str]:
    """The names of recordings; in place of a name that several have, their files."""
    names = [recording.name for recording in recordings]
    return [each.name if names.count(each.name) == 1 else each.label for each in recordings]


def _levels(model: ArmModel, recordings: list[Recording]) -> Levels:
    """The levels that errors of a model on recordings are compared with."""
    noise, source = noise_of(recordings)
    discrepancy = model_discrepancy(model, noise)
    return Levels(
        float(np.sqrt(np.mean(noise**2))),
        float(np.sqrt(np.mean(discrepancy**2))),
        floor_to_tell(noise, source),
    )


def _of_one_setup(model: ArmModel, recordings: list[Recording]) -> SetupResult | None:
    """The faults of recordings that share them."""
    levels = _levels(model, recordings)
    dead, masked, commanded = dead_channels(model.spec, recordings)
    search = _search(model, masked, levels)
    mixed = mixed_units(search.coarse)
    if mixed is not None:
        return _of_mixed_units(model, recordings, mixed, levels)
    search, found = search.likelier_clock()
    taken: tuple[int, ...] = ()
    blind: Blind | None = None
    if dead.chambers and search.noticed:
        if commanded is not masked:
            driven = _search(model, commanded, levels)
            if search.time_factor != 1.0:
                driven = driven.in_time(search.time_factor)
            better = driven.run()
            after = better.best.rmse_mm if better else driven.start.rmse_mm
            if driven.explains(search.raw.rmse_mm, after):
                search, found, taken = driven, better, dead.chambers
        if not taken and found is None and len(dead.chambers) == 1:
            blind = blind_channel(search, dead.chambers[0])
    return _Report(model, recordings, search, found, dead, taken, blind).result()


def _of_mixed_units(
    model: ArmModel, recordings: list[Recording], mixed: MixedUnits, levels: Levels
) -> SetupResult:
    """The result for key points in another unit: nothing else is tested, because all that was
    found beside them would be wrong."""
    fault, unit = mixed.fault, model.spec.unit
    as_recorded = Arrangement.as_recorded(model.spec.chambers)
    return SetupResult(
        faults=(fault,),
        alternatives=(),
        sentence=fault.sentence,
        instructions=mixed.instructions,
        alternative_instructions=(),
        how_to_tell="",
        before_mm=mixed.before_mm,
        after_mm=mixed.after_mm,
        floor_mm=levels.told_noise,
        recordings=tuple(recording.name for recording in recordings),
        correctable=False,
        correction=Correction(as_recorded, tuple(range(model.spec.key_points)), unit, unit),
    )


def _search(model: ArmModel, recordings: list[Recording], levels: Levels) -> Search:
    sizes = (SETTINGS.coarse_rows, SETTINGS.fine_rows, EVERY_ROW)
    coarse, fine, full = samples_of(model, recordings, sizes)
    actuation = np.concatenate([actuation_of(r, model.spec.actuation) for r in recordings])
    mistakes, orders = mistaken(model.spec, actuation), _shows_orders(model, actuation)
    return Search(coarse, fine, full, levels, mistakes, orders=orders)


def _shows_orders(model: ArmModel, actuation: np.ndarray) -> bool:
    """Whether an actuation (T, m) can show that channels were exchanged.

    Where channels move together that did not in the recordings of the fit, the model extrapolates,
    and some exchange leads back to motions that it knows: on an unchanged pneumatic arm whose
    channels moved in two groups, an exchange of all six took the error from 43 to 14 mm. There an
    exchange has to explain nearly all (`Proof.tied`).
    """
    known = model.training_residuals
    if known is None:
        return True
    fitted = known.actuation if known.past is None else known.past.actuation
    return tied_channels(actuation) <= tied_channels(fitted.numpy())


@dataclass(frozen=True, eq=False)
class _Report:
    """What the tests of some recordings found, before it is put into words."""

    model: ArmModel
    recordings: list[Recording]
    search: Search
    found: Found | None
    dead: Dead
    taken: tuple[int, ...]
    """Dead channels in whose place the command explains the motion."""
    blind: Blind | None

    def result(self) -> SetupResult | None:
        """The result in words; None where nothing is wrong."""
        best = self.found.best if self.found else self.search.start
        given = self.blind.hypothesis if self.blind else best.hypothesis
        frame = self.blind.frame if self.blind else self._exact(best)
        after = self.blind.rmse_mm if self.blind else best.rmse_mm
        lost = self._lost(given)
        silent = (self.blind.channel,) if self.blind else self.taken
        frozen = self.dead.frozen
        if frozen and not (self.found or self.blind):
            frozen = frozen if self.search.explains(self._raw_error(), after) else {}
        faults = [_dead_key_point(k, self.dead.key_points[k]) for k in lost]
        faults += [_dead_chamber(k, self.blind) for k in silent]
        faults += [_frozen_chamber(k, share) for k, share in frozen.items()]
        if self.found:
            faults += self._faults(best, frame)
        elif self.blind:
            faults += self.blind.further(self._unit, self._mistake(given))
        other_time = self._time_unit()
        faults = [*other_time, *faults]
        if not faults:
            return None
        before = self._raw_error()
        whole = self.dead.key_points
        correction = replace(
            self._correction(given, frame),
            from_command=self.taken,
            lost=tuple(k for k in lost if whole[k] > WHOLE),
            stale=tuple(k for k in lost if whole[k] <= WHOLE),
            frozen=bool(frozen),
        )
        others = [(o, self._exact(o)) for o in (self.found.as_good if self.found else ())]
        alternatives = tuple((*other_time, *self._faults(o, f)) for o, f in others)
        instructions, correctable = self._instructions(correction)
        of_model = self._length_of_model(given)
        how_to_tell = _how_to_tell(faults, (*alternatives, *of_model))
        text = "; or ".join((*(joined(some) for some in (faults, *alternatives)), *of_model))
        floor_mm = self.search.levels.told_noise
        silent_model = other_time and len(faults) == 1 and before <= PROOF.as_good * after
        if silent_model:
            text += f": the error is {before:.3g} mm as read and {after:.3g} mm with the correction"
        elif correctable:
            # The search predicts without memory; what is said holds for the whole model.
            read, right = self.recordings, [correction.applied(r) for r in self.recordings]
            whole_model = [fit_of_model(self.model, each) for each in (read, right)]
            before, after = (
                level if fit is None else fit.rmse_mm
                for fit, level in zip(whole_model, (before, after), strict=True)
            )
            text += f": the correction reduces the error from {before:.3g} to {after:.3g} mm"
            if given.mm_per_unit != 1.0:
                floor_mm = floor_to_tell(*noise_of(right))
        return SetupResult(
            faults=tuple(faults),
            alternatives=alternatives,
            sentence=text,
            instructions=instructions,
            alternative_instructions=tuple(
                self._correction(o.hypothesis, f).lines(self._commands) for o, f in others
            ),
            how_to_tell=SLOW_OR_WRONG if silent_model else how_to_tell,
            before_mm=before,
            after_mm=after,
            floor_mm=floor_mm,
            recordings=tuple(recording.name for recording in self.recordings),
            correctable=correctable,
            correction=correction,
            of_model="; or ".join(of_model),
        )

    @property
    def _unit(self) -> str:
        """The model's unit of actuation."""
        return self.model.spec.unit

    @property
    def _commands(self) -> bool:
        """Whether every recording has a command."""
        return all(recording.commanded is not None for recording in self.recordings)

    def _mistake(self, given: Hypothesis) -> tuple[str, str]:
        """The unit that the actuation is truly in, and the one that it was read as."""
        names = {factor: mistake for mistake, factor in self.search.mistakes.items()}
        return names.get(given.arrangement.factor, (self._unit, self._unit))

    def _faults(self, given: Fitted, frame: Frame) -> list[SetupFault]:
        return faults_of(given, frame, self._unit, self._mistake(given.hypothesis))

    def _length_of_model(self, given: Hypothesis) -> tuple[str, ...]:
        """That the model may be in another unit of length, and not the recordings.

        Only of a callable or predictions, and not where the stated length tells that the unit of
        the recordings is wrong.
        """
        spec, unit = self.model.spec, given.mm_per_unit
        if unit == 1.0 or not is_of_other_origin(self.model):
            return ()
        lengths = body_lengths(self.model.rest_mm.double().numpy()[None], self.recordings)
        if lengths and spec.length_mm and not lengths.blame_model(spec.length_mm):
            return ()
        return (model_in_other_unit(1 / unit),)

    def _time_unit(self) -> list[SetupFault]:
        """The fault that times are in another unit, where that is so."""
        factor, true_s = self.search.time_factor, self.search.row_s
        return [] if factor == 1.0 else [time_unit_fault(factor, true_s)]

    def _exact(self, given: Fitted) -> Frame:
        """The frame of an explanation: axes or a shift only, where these do as well."""
        if given.hypothesis.frame not in HANDED:
            return given.frame
        axes = signed_axes()
        axes = axes[np.linalg.det(axes) * np.linalg.det(given.frame.rotation) > 0]
        apart = angle(np.einsum("aij,kj->aik", axes, given.frame.rotation))
        nearest = axes[int(apart.argmin())]
        if apart.min() > EXACT_RAD:
            return given.frame
        scale, sums = given.frame.scale, given.blocks.summed()
        limit = PROOF.as_good * max(given.rmse_mm, self.search.levels.reference)
        for plain in (Frame(nearest, np.zeros(3), scale), shifted(nearest, sums, scale)):
            if np.sqrt(sums.mean_square(plain)) <= limit:
                return plain
        return given.frame

    def _correction(self, given: Hypothesis, frame: Frame) -> Correction:
        turned = given.frame in HANDED
        rotation = np.asarray(frame.rotation).T
        exact = np.abs(rotation - np.round(rotation)).max() < 1e-9
        rotation = np.round(rotation) + 0.0 if exact else rotation
        identity = np.array_equal(rotation, np.eye(3))
        shift = np.asarray(frame.shift) * given.mm_per_unit
        true, read = self._mistake(given)
        return Correction(
            arrangement=given.arrangement,
            points=given.points,
            unit=self._unit,
            recorded_unit=true if read == self._unit else self._unit,
            mm_per_unit=given.mm_per_unit,
            rotation=rotation if turned and not identity else None,
            origin_mm=shift if turned and shift.any() else None,
            delay_s=-given.later_s,
            time_factor=self.search.time_factor,
            gravity=self.model.spec.gravity,
        )

    def _instructions(self, correction: Correction) -> tuple[str, bool]:
        """How to correct the set-up, and whether that is possible without recording again."""
        lines = correction.lines(self._commands)
        still = [k for k, sign in enumerate(correction.arrangement.sign) if sign == 0.0]
        again = ""
        if self.blind:
            again = f"record again with a sensor that reads channel {self.blind.channel + 1}"
        elif still:
            again = f"check chamber {still[0] + 1} (valve, line, leak) and record again"
        if not again:
            return lines, True
        other = [table for table in correction.tables(False) if table != "measured"]
        beside = f"{again}; beside that\n{lines}"
        return beside if other or (self.blind and lines) else again, False

    def _lost(self, given: Hypothesis) -> list[int]:
        """Recorded key points that stand still and, by the model, should not."""
        if not self.dead.key_points:
            return []
        moved = self.search.motion(given.arrangement)
        least = max(LEAST_MOTION * moved.max(), 5 * self.search.levels.noise)
        return [k for k in sorted(self.dead.key_points) if moved[given.points.index(k)] > least]

    def _raw_error(self) -> float:
        """RMS error on the training rows as recorded, mm."""
        sample = sample_of(self.model, self.recordings, SETTINGS.fine_rows)
        plain = Arrangement.as_recorded(sample.history.chambers)
        apart = np.square(sample.measured()[0] - sample.predicted([plain])[0]).sum(2)
        return float(np.sqrt(np.nanmean(apart)))


def _dead_key_point(k: int, share: float) -> SetupFault:
    how = "is dead: it keeps one position"
    if share <= WHOLE:
        how = f"is frozen in {share:.0%} of the rows"
    numbers: dict[str, float | list] = {"key_point": float(k), "share_of_rows": share}
    return SetupFault("dead_key_point", f"key point k{k} {how}, while the arm moves", numbers)


def _dead_chamber(k: int, blind: Blind | None) -> SetupFault:
    text = f"channel {k + 1} is dead: it keeps one value, while the body moves"
    numbers: dict[str, float | list] = {"channel": float(k + 1)}
    if blind is None:
        text += " as the command says"
    else:
        low, high = blind.range
        text += f" as if it were driven between {low:.3g} and {high:.3g} {blind.unit}"
        numbers["range"] = [low, high]
    return SetupFault("dead_chamber", text, numbers)


def _frozen_chamber(k: int, share: float) -> SetupFault:
    text = f"channel {k + 1} is frozen in {share:.0%} of the rows"
    return SetupFault("dead_chamber", text, {"channel": float(k + 1), "share_of_rows": share})


TESTS = {
    "chambers": "pressurise one chamber alone and see which one fills",
    "frame": "move a marker along one axis of the cameras and see which column changes",
    "key_points": "cover the tip's marker and see which key point is lost",
    "length_unit": "compare a distance with a ruler",
    "actuation_unit": "compare a reading with a gauge",
    "time": "tap the arm and compare the clocks",
    "time_unit": "compare the length of the recording with a watch",
}
"""What to do on the bench to find out whether a fault of each kind is there."""


def _how_to_tell(faults: Sequence[SetupFault], alternatives: Sequence) -> str:
    """What to do on the bench to tell explanations apart.

    alternatives: the faults of each other explanation, or its words where the model is wrong.
    """
    if not alternatives:
        return ""
    of_setup = [some for some in (faults, *alternatives) if not isinstance(some, str)]
    kinds = {fault.kind for some in of_setup for fault in some}
    return "to distinguish them: " + "; or ".join(TESTS[kind] for kind in TESTS if kind in kinds)
