"""How often such a statement was right: a logistic curve on what the decision was made from.

Fitted, with a ridge of 1, to 425 statements about virtual robots (specimens 104 to 111, drawn as
seeds 3, 4, 6 and 7 of `surgisoft benchmark diagnosis` draw them), 96 % of which were right; the
robots that the benchmark reports are others. Nearly all that were wrong are about robots whose
effect is outside the list: a leaking chamber or sensors that see each other look like a coupling or
a gain, sticking looks like hysteresis. Of 21 ambiguous statements 17 were right about the first
effect.
"""

import math

WEIGHTS = {"constant": 5.38, "rival": -1.47, "loose": -128.0}
"""Log odds for each unit of what follows."""
IMITATED = {"coupling": -2.35, "gain_mismatch": -2.35, "hysteresis": -1.85}
"""Log odds of effects that those outside the list look like."""
AMBIGUOUS = 0.81
"""Most confidence where rivals are told that explain as much."""


def confidence(numbers: dict) -> float:
    """Calibrated chance that the first effect named is missing, from `diagnose.statistics`.

    rival: the runner-up's gain beside the first's; loose: what goes besides when the effects' forms
    are let loose, as in `race.form.Loosened.worth`. The name of the first counts too.
    """
    if not numbers["named"]:
        return 0.0
    values = {
        "constant": 1.0,
        "rival": min(max(numbers["runner_gain"] / max(numbers["gain"], 1e-6), 0.0), 1.2),
        "loose": max(numbers["loose_share"], 0.0) * max(numbers["loose_log_gain"], 0.0),
    }
    odds = sum(WEIGHTS[name] * value for name, value in values.items())
    odds += IMITATED.get(numbers["steps"][0][0], 0.0)
    chance = 1.0 / (1.0 + math.exp(-odds))
    return min(chance, AMBIGUOUS) if numbers["rivals"] else chance
