"""How often such a statement was right: a logistic curve on what the decision was made from.

Fitted to 124 statements about virtual robots of the calibration (specimens 101 to 103, drawn as
seed 1 of `surgisoft benchmark diagnosis` draws them, the network's known error beside), 90 % of
which were right; the benchmark's own robots are others. Nearly all that were wrong are about robots
whose effect is outside the list or whose rivals are told.
"""

import math

WEIGHTS = {
    "constant": 1.37,
    "explained": 2.09,
    "rival": -0.62,
    "left": -0.19,
    "ambiguous": -1.94,
}
"""Log odds for each unit of what follows."""


def confidence(numbers: dict) -> float:
    """Calibrated chance that the first effect named is missing, from `diagnose.statistics`.

    explained: share of the error above the floor; rival: the runner-up's gain beside the first's;
    left: log of the factor on the validated error that what is left would take; ambiguous: whether
    rivals are told that explain as much.
    """
    if not numbers["named"]:
        return 0.0
    values = {
        "constant": 1.0,
        "explained": numbers["explained_above_floor"],
        "rival": min(max(numbers["runner_gain"] / max(numbers["gain"], 1e-6), 0.0), 1.2),
        "left": min(math.log(numbers["static_size_after"]), 2.5),
        "ambiguous": float(numbers["named"] == 1 and numbers["rivals"] > 0),
    }
    odds = sum(WEIGHTS[name] * value for name, value in values.items())
    return 1.0 / (1.0 + math.exp(-odds))
