"""How often such a statement was right: a logistic curve on what the decision was made from."""

import math


def confidence(numbers: dict) -> float:
    """Calibrated chance that the first effect named is missing, from `diagnose.statistics`."""
    if not numbers["named"]:
        return 0.0
    z = -1.0 + 0.8 * min(numbers["margin"], 6.0) + 2.0 * numbers["explained_above_floor"]
    return 1.0 / (1.0 + math.exp(-z))
