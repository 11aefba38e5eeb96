"""How often such a statement was right: a logistic curve on what the decision was made from.

Fitted to 218 statements about virtual robots of the calibration (specimens 101 to 103, seed 1 of
`surgisoft benchmark diagnosis`), 88 % of which were right; the benchmark's own robots are others.
"""

import math

WEIGHTS = {
    "constant": 0.34,
    "margin": 0.36,
    "explained": 2.46,
    "rival": -0.99,
    "left": -0.62,
}
"""Log odds for each unit of what follows."""


def confidence(numbers: dict) -> float:
    """Calibrated chance that the first effect named is missing, from `diagnose.statistics`.

    margin: studentised lead over the runner-up by blocks; explained: share of the error above the
    floor; rival: the runner-up's gain beside the first's; left: log of the factor on the validated
    error that what is left would take.
    """
    if not numbers["named"]:
        return 0.0
    values = {
        "constant": 1.0,
        "margin": min(max(numbers["margin"], -2.0), 6.0),
        "explained": numbers["explained_above_floor"],
        "rival": min(max(numbers["runner_gain"] / max(numbers["gain"], 1e-6), 0.0), 1.2),
        "left": min(math.log(numbers["static_size_after"]), 2.5),
    }
    odds = sum(WEIGHTS[name] * value for name, value in values.items())
    return 1.0 / (1.0 + math.exp(-odds))
