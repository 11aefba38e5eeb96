"""What a named effect leaves behind because its form is only nearly right.

No effect of a real arm has exactly its model's form, and what that leaves looks like a further,
smaller effect. So before a further effect is named, those before it are let loose: what each of
them explains may be scaled by any first-order function of the chambers' pressures, of their
directions and of the place along the body. Only what a further effect explains beside that is its
own. (The discrepancy term of Kennedy & O'Hagan 2001, here for the form of an effect.)

Where effects that are let loose explain much more than they do as they are, their form is not that
of what is missing: they are its nearest relatives only, and something unknown is missing. So it is
where they explain much more with a strength of their own in every part of the time.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from surgisoft.diagnosis.race.cross_validation import CrossValidation
from surgisoft.diagnosis.race.gates import family_p_values
from surgisoft.diagnosis.race.ranking import Race, Standing, picked_by

WRONG = 0.015
"""Least product of what goes when a form is let loose, as a share of the error above the floor, and
the mean fall of a block's log error, from which that form is wrong."""
MUCH = 0.1
"""Or, however noisy the blocks, that share by itself."""
SPANS = 4
"""Parts of the recordings in which what a form explains may be scaled on its own."""
CHANCE = 0.02
"""Largest chance of such a fall."""

Scaled = Callable[[Race, np.ndarray], np.ndarray]
"""(S, n, 3, K) columns of what an effect explains (S, n, 3), each scaled by something."""


@dataclass(frozen=True, eq=False)
class Loosened:
    """What named effects explain more where their forms are let loose."""

    losses: np.ndarray
    """(B,) held-out sum of squared distances by block, mm^2."""
    share: float
    """Share of the error above the floor that goes besides."""
    log_gain: float
    """Mean fall of a block's log error."""
    p_value: float
    """Chance of such a fall without a cause."""

    @property
    def worth(self) -> float:
        """Share that goes times the mean fall of the log error; 0 where either rises."""
        return max(self.share, 0.0) * max(self.log_gain, 0.0)

    @property
    def wrong(self) -> bool:
        """Whether the forms are not those of what is missing."""
        return (self.worth >= WRONG or self.share >= MUCH) and self.p_value <= CHANCE


def loosened(race: Race, ways: Sequence[Sequence[Standing]]) -> Loosened:
    """What the best of several ways to explain the error, let loose, does beyond all of them.

    ways: sets of effects that explain the error about as well; one set where nothing rivals it.
    """
    tried = []
    for named, scaled in itertools.product(ways, (_by_state, _by_time)):
        columns = _loose_columns(race, named, scaled)
        validation = CrossValidation.on(race.validation.split, columns)
        tried.append(validation.losses(range(columns.shape[3])))
    best = min(tried, key=np.sum)
    beyond = [_beyond(race, picked_by(named), best) for named in ways]
    return min(beyond, key=lambda one: one.worth)


def _beyond(race: Race, picked: tuple[int, ...], after: np.ndarray) -> Loosened:
    before = race.losses(picked)
    log_gain, chance = _fall(race, before, after)
    share = (before.sum() - after.sum()) / race.excess(race.losses())
    return Loosened(after, float(share), float(log_gain.mean()), chance)


def _fall(race: Race, before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, float]:
    """(B,) fall of each block's log error, and the chance of such a fall without a cause."""
    log_gain = race.log_ratio(before, after)
    gain = race.problem.by_motion(log_gain[None])
    return log_gain, float(family_p_values(gain)[0]) if log_gain.any() else 1.0


def beside_loose(race: Race, named: list[Standing], further: Standing) -> tuple[float, Standing]:
    """(loss of the named effects let loose in mm^2, the further effect's standing beside them).

    The chance counts this one effect alone: the others have been corrected for before.
    """
    picked = further.option.picked
    columns = [_loose_columns(race, named, _by_state), race.columns[..., list(picked)]]
    together = np.concatenate(columns, axis=3)
    validation, total = CrossValidation.on(race.validation.split, together), together.shape[3]
    before, after = (validation.losses(range(n)) for n in (total - len(picked), total))
    log_gain, chance = _fall(race, before, after)
    gain = float((before.sum() - after.sum()) / race.excess(before))
    answer = Standing(further.effect, further.option, after, log_gain, chance, gain)
    return float(before.sum()), answer


def _loose_columns(race: Race, named: Sequence[Standing], scaled: Scaled) -> np.ndarray:
    """(S, n, 3, K) the named effects' columns, and what each of them explains, scaled."""
    ways = [race.freest(standing) for standing in named]
    base = sum(ways, ())
    amplitudes = race.validation.amplitudes(base)
    columns, first = [race.columns[..., list(base)]], 0
    for picked in ways:
        part = race.columns[..., list(picked)] @ amplitudes[first : first + len(picked)]
        columns.append(scaled(race, part))
        first += len(picked)
    return np.concatenate(columns, axis=3)


def _by_state(race: Race, part: np.ndarray) -> np.ndarray:
    """(S, n, 3, 2 m + 1) what an effect explains (S, n, 3), scaled."""
    points = part.shape[1]
    along = np.linspace(-1.0, 1.0, points) if points > 1 else np.zeros(1)
    rows = np.concatenate([race.problem.pressure, race.problem.direction], axis=1)
    scaled = part[..., None] * rows[:, None, None, :]
    return np.concatenate([scaled, (part * along[:, None])[..., None]], axis=3)


def _by_time(race: Race, part: np.ndarray) -> np.ndarray:
    """(S, n, 3, SPANS - 1) what an effect explains, in each part of the time but the first."""
    span = SPANS * np.arange(len(part)) // len(part)
    return part[..., None] * (span[:, None] == np.arange(1, SPANS))[:, None, None, :]
