"""How often such a statement was right: a logistic curve on what the decision was made from.

Fitted to 118 statements about virtual robots of the calibration (specimens 101 to 103, drawn as
seed 1 of `surgisoft benchmark diagnosis` draws them and ten more with effects outside the list, the
network's known error beside), 94 % of which were right; the benchmark's own robots are others.
Nearly all that were wrong are about robots whose effect is outside the list or whose rivals are
told.
"""

import math

WEIGHTS = {"constant": 3.27, "explained": 1.02, "rival": -1.1, "ambiguous": -1.98}
"""Log odds for each unit of what follows."""


def confidence(numbers: dict) -> float:
    """Calibrated chance that the first effect named is missing, from `diagnose.statistics`.

    explained: share of the error above the floor; rival: the runner-up's gain beside the first's;
    ambiguous: whether rivals are told that explain as much.
    """
    if not numbers["named"]:
        return 0.0
    values = {
        "constant": 1.0,
        "explained": numbers["explained_above_floor"],
        "rival": min(max(numbers["runner_gain"] / max(numbers["gain"], 1e-6), 0.0), 1.2),
        "ambiguous": float(numbers["named"] == 1 and numbers["rivals"] > 0),
    }
    odds = sum(WEIGHTS[name] * value for name, value in values.items())
    return 1.0 / (1.0 + math.exp(-odds))
