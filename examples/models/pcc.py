"""A constant-curvature arm as a callable model: plain NumPy, one circular arc.

An arc of length L bends by the vector b (rad) in the plane of b; both are linear in the pressures
(Webster & Jones 2010, "Design and kinematic modeling of constant curvature continuum robots"):

    b = B p + b_0,   L = L_0 + l p,   a = |b|
    point at share s of the arc:  x, y = L (1 - cos(s a)) / (s a^2) s b,   z = L sin(s a) / a

Fit it to a recording of your arm, then use it as any model:

    python examples/models/pcc.py before.parquet pcc.json
    PCC=pcc.json surgisoft diagnose examples/models/pcc.py:arm bench.parquet --before before.parquet
"""

import json
import os
import sys
from pathlib import Path

import numpy as np


class ConstantCurvatureArm:
    """One arc; each row of the actuation gives the body of that row, whatever came before."""

    static = True

    def __init__(self, parameters):
        self.bend = np.array(parameters["bend_rad_per_kPa"])  # (2, m)
        self.offset = np.array(parameters["bend_at_rest_rad"])  # (2,)
        self.stretch = np.array(parameters["stretch_mm_per_kPa"])  # (m,)
        self.length_mm = parameters["length_mm"]
        self.shares = np.array(parameters["shares"])  # (n,), base 0 to tip 1
        self.low, self.high = parameters["low_kPa"], parameters["high_kPa"]
        self.unit = "kPa"

    def __call__(self, time_s, actuation):
        """Key points (T, n, 3) in mm, base frame, from actuation (T, m) in kPa."""
        bend = actuation @ self.bend.T + self.offset
        length = (self.length_mm + actuation @ self.stretch)[:, None] * self.shares
        part = bend[:, None, :] * self.shares[:, None]  # (T, n, 2), the bend up to each key point
        angle = np.linalg.norm(part, axis=-1)
        across = 0.5 * length * np.sinc(angle / (2 * np.pi)) ** 2  # L (1 - cos a) / a^2
        along = length * np.sinc(angle / np.pi)  # L sin(a) / a
        return np.concatenate([across[..., None] * part, along[..., None]], -1)


def fitted(actuation, key_points_mm):
    """Parameters of the arc that is nearest to measured key points (T, n, 3) in mm."""
    from scipy.optimize import least_squares

    seen = np.isfinite(key_points_mm).all((1, 2))
    rows = np.flatnonzero(seen)[:: max(1, int(seen.sum()) // 1000)]
    p, y = actuation[rows], key_points_mm[rows]
    m, n = p.shape[1], y.shape[1]
    middle = y.mean(0)
    length = float(np.linalg.norm(np.diff(middle, axis=0), axis=1).sum())

    def parameters(values):
        bend, offset, stretch, free = np.split(values, [2 * m, 2 * m + 2, 3 * m + 2])
        return {
            "bend_rad_per_kPa": bend.reshape(2, m).tolist(),
            "bend_at_rest_rad": offset.tolist(),
            "stretch_mm_per_kPa": stretch.tolist(),
            "length_mm": float(free[0]),
            "shares": [0.0, *free[1:].tolist(), 1.0],
            "low_kPa": actuation.min(0).tolist(),
            "high_kPa": actuation.max(0).tolist(),
        }

    start = np.zeros(3 * m + 2 + 1 + n - 2)
    start[3 * m + 2 :] = [length, *np.linspace(0, 1, n)[1:-1]]
    start[: 2 * m] = 1e-3
    time = np.zeros(len(p))
    found = least_squares(
        lambda values: (ConstantCurvatureArm(parameters(values))(time, p) - y).ravel(), start
    )
    return parameters(found.x)


EXAMPLE = Path(__file__).with_name("pcc.json")
arm = None
if __name__ != "__main__":
    arm = ConstantCurvatureArm(json.loads(Path(os.environ.get("PCC", EXAMPLE)).read_text()))


if __name__ == "__main__":
    import surgisoft

    recording = surgisoft.load_recording(sys.argv[1])
    values = fitted(recording.measured, recording.key_points_mm)
    Path(sys.argv[2]).write_text(json.dumps(values, indent=2) + "\n")
    residual = ConstantCurvatureArm(values)(recording.t_s, recording.measured)
    residual -= recording.key_points_mm
    print(f"RMS error of a key point {np.sqrt(np.nanmean((residual**2).sum(-1))):.3f} mm")
