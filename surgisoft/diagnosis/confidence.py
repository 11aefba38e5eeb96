"""How often such a statement was right: a logistic curve on what the decision was made from.

Fitted, with a ridge of 1, to 364 statements about virtual robots (specimens 104 to 111, drawn as
seeds 3, 4 and 6 of `surgisoft benchmark diagnosis` draw them), 97 % of which were right; the robots
that the benchmark reports are others. Nearly all that were wrong are about robots whose effect is
outside the list. Of 19 ambiguous statements 15 were right about the first effect.
"""

import math

WEIGHTS = {"constant": 4.76, "rival": -1.51, "loose": -190.0}
"""Log odds for each unit of what follows."""
AMBIGUOUS = 0.79
"""Most confidence where rivals are told that explain as much."""


def confidence(numbers: dict) -> float:
    """Calibrated chance that the first effect named is missing, from `diagnose.statistics`.

    rival: the runner-up's gain beside the first's; loose: what goes besides when the effects' forms
    are let loose, as in `race.form.Loosened.worth`.
    """
    if not numbers["named"]:
        return 0.0
    values = {
        "constant": 1.0,
        "rival": min(max(numbers["runner_gain"] / max(numbers["gain"], 1e-6), 0.0), 1.2),
        "loose": max(numbers["loose_share"], 0.0) * max(numbers["loose_log_gain"], 0.0),
    }
    odds = sum(WEIGHTS[name] * value for name, value in values.items())
    chance = 1.0 / (1.0 + math.exp(-odds))
    return min(chance, AMBIGUOUS) if numbers["named"] == 1 and numbers["rivals"] else chance
