"""What a named effect leaves behind because its form is only nearly right.

No effect of a real arm has exactly its model's form, and what that leaves looks like a further,
smaller effect. So before a further effect is named, those before it are let loose: what each of
them explains may be scaled by any first-order function of the chambers' pressures, of their
directions and of the place along the body. Only what a further effect explains beside that is its
own. (The discrepancy term of Kennedy & O'Hagan 2001, here for the form of an effect.)
"""

import numpy as np

from surgisoft.diagnosis.race.gates import family_p_values
from surgisoft.diagnosis.race.ranking import Race, Standing, validation_of


def beside_loose(race: Race, named: list[Standing], further: Standing) -> tuple[float, Standing]:
    """(excess of the named effects let loose in mm^2, the further effect's standing beside them).

    The chance counts this one effect alone: the others have been corrected for before.
    """
    base = sum((standing.option.picked for standing in named), ())
    amplitudes = race.validation.amplitudes(base)
    columns, first = [race.columns[..., list(base)]], 0
    for standing in named:
        count = len(standing.option.picked)
        picked = list(standing.option.picked)
        part = race.columns[..., picked] @ amplitudes[first : first + count]
        columns.append(_loose(race, part))
        first += count
    columns.append(race.columns[..., list(further.option.picked)])
    together = np.concatenate(columns, axis=3)
    validation = validation_of(race.problem, together)
    total = together.shape[3]
    before = validation.losses(range(total - len(further.option.picked)))
    after = validation.losses(range(total))
    log_gain = race.log_ratio(before, after)
    chance = float(family_p_values(log_gain[None])[0]) if log_gain.any() else 1.0
    excess = race.excess(before)
    gain = (before.sum() - after.sum()) / excess
    answer = Standing(further.effect, further.option, after, log_gain, chance, float(gain))
    return float(before.sum()), answer


def _loose(race: Race, part: np.ndarray) -> np.ndarray:
    """(S, n, 3, 2 m + 1) what an effect explains (S, n, 3), scaled."""
    points = part.shape[1]
    along = np.linspace(-1.0, 1.0, points) if points > 1 else np.zeros(1)
    rows = np.concatenate([race.problem.pressure, race.problem.direction], axis=1)
    scaled = part[..., None] * rows[:, None, None, :]
    return np.concatenate([scaled, (part * along[:, None])[..., None]], axis=3)
