"""What is weak about the data of a diagnosis, said before anything is named."""

import numpy as np
from scipy.spatial import cKDTree

from surgisoft.diagnosis.problem import Problem

FAR_FROM_FIT, LEAST_FAR, FAR_ROWS = 2.0, 0.2, 0.1
"""Factor on the distance that nearly all actuations of the fit keep from their nearest, from which
another is far from them, the least such distance in half ranges, and the share of such rows that is
told."""


def _far_from_fit(problem: Problem) -> float:
    """Share of the rows whose actuation lies far from all that the model was fitted on."""
    known = problem.reference
    if known is None or len(known.pressure) < 2:
        return 0.0
    tree = cKDTree(known.pressure)
    own = tree.query(known.pressure, k=2, p=np.inf)[0][:, 1]
    apart = tree.query(problem.pressure, p=np.inf)[0]
    return float(np.mean(apart > max(FAR_FROM_FIT * np.quantile(own, 0.97), LEAST_FAR)))


def weaknesses(problem: Problem) -> list[str]:
    """One sentence for each weakness."""
    answer = []
    if problem.floor_source == "second differences":
        answer.append(
            "the noise is not stated and no holds show it: it was taken from second differences "
            "in time; state noise_mm in the sidecar for a better floor"
        )
    blocks, motions = len(problem.motion), int(problem.motion.max()) + 1
    if 2 * motions <= blocks:
        answer.append(
            f"the recordings repeat themselves: their {blocks} blocks of time show {motions} "
            "different motions, and each counts once; record other paths and speeds"
        )
    far = _far_from_fit(problem)
    if far > FAR_ROWS:
        answer.append(
            f"{100 * far:.0f} % of the rows are at actuations far from those that the model was "
            "fitted on, where it is off by more: an effect that shows there alone may be its own "
            "error"
        )
    validated = problem.model.validation.rmse_mm
    noise = float(np.sqrt(np.mean(problem.noise_mm**2)))
    if validated and problem.floor_source == "holds" and noise > validated:
        answer.append(
            f"while the arm is held the key points scatter by {noise:.3g} mm, more than "
            f"the model's whole validated error ({validated:.3g} mm): worse cameras, or something "
            "shakes the arm; what is smaller is not seen"
        )
    missing = float(np.isnan(problem.measured).mean())
    if missing > 0.2:
        answer.append(f"{100 * missing:.0f} % of the key points are missing")
    return answer
