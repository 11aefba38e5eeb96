"""Models of real robots: error beside black boxes, and coverage of intervals, on held-out runs.

    python -m benchmarks.real_models RECORDING.parquet [--network auto] [--actuation commanded]

Runs, or blocks of time of a single run, are dealt into folds. Each fold is left out once; on the
others a model is fitted as `surgisoft fit` does with the options `--network`, `--prior`,
`--effects`, `--members` and `--epochs`, and three black boxes are too. None of them sees the
left-out fold before it is judged there; what each of them chooses by held-out data, it chooses
inside the other folds.

Black boxes: the recurrent network of `fit --network recurrent`; ridge regression on the actuation
and its low passes, with all products of two; and kernel ridge regression (Gaussian kernel, Nystroem
approximation) on the same. The last two choose their sizes on a fifth of the training groups.
"""

import argparse
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from surgisoft.errors import InputError
from surgisoft.measurement.histories import arm_spec, history_of
from surgisoft.measurement.recordings import load_recordings
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.fit import FitConfig, fit
from surgisoft.surrogate.history import History
from surgisoft.surrogate.interval import coverage_of
from surgisoft.surrogate.scan import linear_scan
from surgisoft.surrogate.training import dealt

LOW_PASSES_S = (0.1, 0.3, 1.0, 4.0)
"""Time constants of the black boxes' memory, s."""
RIDGES = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
"""Ridges of the polynomial black box, as shares of the features' mean square."""
WIDTHS = (1.0, 2.0, 4.0)
"""Widths of the kernel, in half ranges of a chamber."""
KERNEL_RIDGES = (1e-2, 1.0)
"""Ridges of the kernel black box, in rows."""
LANDMARKS = 800
"""Rows that carry the kernel's approximation."""
MOST_ROWS = 6000
"""Largest number of rows that ridge and kernel regression are fitted to, evenly thinned."""


@dataclass(frozen=True)
class Fold:
    """One model on one left-out fold: squared distances of its measured key points."""

    name: str
    """Name of the model."""
    square_mm2: np.ndarray
    """(S, n) squared distance of each key point, mm^2; NaN where missing."""
    inside: np.ndarray | None = None
    """(S, n) whether the key point lies within the 95 % interval, where the model states one."""
    radius_mm: np.ndarray | None = None
    """(S, n) radius of that interval, mm."""
    group: np.ndarray | None = None
    """(S,) number of the run, or of its block of time, of each row."""


def without(history: History, left_out: torch.Tensor) -> History:
    """The history with key points missing in the left-out rows, a (R, T) mask."""
    points = torch.where(left_out[..., None, None], torch.nan, history.key_points)
    seen = ~points.isnan().flatten(2).all(-1).all(-1)
    return replace(history, key_points=points).select(seen.nonzero()[:, 0])


def features(history: History, spec: ArmSpec) -> np.ndarray:
    """(S, 5 m) actuation and what its low passes lag behind, in half ranges, of every row."""
    low, high, rest = (
        torch.tensor(x, dtype=torch.float64) for x in (spec.low, spec.high, spec.rest)
    )
    half = ((high - low) / 2).clamp(min=1e-9)
    x = (history.pressure.double() - rest) / half
    times = torch.tensor(LOW_PASSES_S, dtype=torch.float64)
    keep = torch.exp(-history.dt_s.double()[..., None, None] / times)
    slow = linear_scan(keep, (1 - keep) * x[..., None], torch.zeros_like(x[:, 0, :, None] * times))
    wide = torch.cat([x, (x[..., None] - slow).flatten(2)], -1)
    rows = history.rows(wide).numpy()
    return rows[:, rows.std(0) > 0.02]


class Ridge:
    """Ridge regression on features and all their products of two."""

    def __init__(self, x: np.ndarray, y: np.ndarray, size: float):
        wide = self._wide(x)
        normal = wide.T @ wide
        ridge = size * np.trace(normal) / len(normal) * np.eye(len(normal))
        self.mean = y.mean(0)
        self.weights = np.linalg.solve(normal + ridge, wide.T @ (y - self.mean))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return self._wide(x) @ self.weights + self.mean

    @staticmethod
    def _wide(x: np.ndarray) -> np.ndarray:
        one, two = np.triu_indices(x.shape[1])
        return np.concatenate([np.ones((len(x), 1)), x, x[:, one] * x[:, two]], axis=1)


class Kernel:
    """Kernel ridge regression with a Gaussian kernel on landmarks (Williams & Seeger 2001)."""

    def __init__(self, x: np.ndarray, y: np.ndarray, size: tuple[float, float]):
        self.width, ridge = size
        picked = np.random.default_rng(0).permutation(len(x))[:LANDMARKS]
        self.landmarks, self.mean = x[picked], y.mean(0)
        rows, few = self._kernel(x), self._kernel(self.landmarks)
        normal = rows.T @ rows + ridge * few + 1e-6 * len(x) * np.eye(len(few))
        self.weights = np.linalg.solve(normal, rows.T @ (y - self.mean))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return self._kernel(x) @ self.weights + self.mean

    def _kernel(self, x: np.ndarray) -> np.ndarray:
        square = np.square(x).sum(1)[:, None] + np.square(self.landmarks).sum(1)
        return np.exp(-(square - 2 * x @ self.landmarks.T).clip(min=0) / (2 * self.width**2))


MOST_KNOWN = 0.02
"""Largest share of left-out rows that also occur in the fit; stalled sensors repeat a few."""
BLACK_BOXES = {
    "ridge with memory": (Ridge, RIDGES),
    "kernel with memory": (Kernel, [(w, r) for w in WIDTHS for r in KERNEL_RIDGES]),
}


def regressions(x: np.ndarray, y: np.ndarray, group: np.ndarray, at: np.ndarray) -> dict:
    """(S, n, 3) predictions in mm, by black box, at features `at`.

    Fitted to features x and key points y (S', n, 3); a fifth of the groups (S',) chooses the size.
    """
    whole = np.flatnonzero(~np.isnan(y).any((1, 2)))
    whole = whole[:: max(1, -(-len(whole) // MOST_ROWS))]
    x, group, flat = x[whole], group[whole], y[whole].reshape(len(whole), -1)
    names = np.random.default_rng(0).permutation(np.unique(group))
    judge = np.isin(group, names[: max(1, len(names) // 5)])
    found = {}
    for name, (kind, sizes) in BLACK_BOXES.items():
        error = [
            np.square(kind(x[~judge], flat[~judge], size)(x[judge]) - flat[judge]).mean()
            for size in sizes
        ]
        best = sizes[int(np.argmin(error))]
        found[name] = kind(x, flat, best)(at).reshape(-1, *y.shape[1:])
    return found


def judge(
    history: History,
    spec: ArmSpec,
    left_out: torch.Tensor,
    config: FitConfig,
    recurrent: bool = True,
) -> list[Fold]:
    """Fit to all rows but the left-out ones, a (R, T) mask, and judge on these.

    recurrent: whether the recurrent network is among the black boxes; it costs most of the time.
    """
    train = without(history, left_out)
    measured = history.key_points[left_out]
    group = dealt(history)
    kept = ~history.rows(left_out)
    result = fit(train, None, spec, config)
    for line in result.lines():
        print("    " + line)
    known = result.model.fitted_rows.share_of(history, history.rows(left_out).numpy())
    if known > MOST_KNOWN:
        raise InputError(
            f"{known:.0%} of the left-out rows are among those of the fit: the recordings repeat "
            "rows; leave the copies out"
        )
    found = result.model.predict_interval(history)
    error = (found.key_points_mm[left_out] - measured).norm(dim=-1)
    radius = found.radius_mm[left_out]
    inside, of_left_out = (error <= radius).numpy(), group.numpy()[~kept]
    folds = [Fold("this model", error.square().numpy(), inside, radius.numpy(), of_left_out)]
    if recurrent:
        black_box = fit(train, None, spec, FitConfig(network="recurrent", epochs=50))
        with torch.no_grad():
            points = black_box.model.predict(history)[left_out]
        folds.append(Fold("recurrent network", (points - measured).square().sum(-1).numpy()))
    x, y = features(history, spec), history.rows(history.key_points).numpy()
    for name, points in regressions(x[kept], y[kept], group.numpy()[kept], x[~kept]).items():
        folds.append(Fold(name, np.square(points - measured.numpy()).sum(-1)))
    return folds


def group_coverage(folds: list[Fold]) -> np.ndarray:
    """(G,) share of the key points of each left-out run, or block, within the interval."""
    found = []
    for fold in folds:
        assert fold.inside is not None
        assert fold.group is not None
        seen = ~np.isnan(fold.square_mm2)
        for name in np.unique(fold.group):
            mine = seen & (fold.group == name)[:, None]
            if mine.any():
                found.append(fold.inside[mine].mean())
    return np.array(found)


def main() -> None:
    """Judge the models on every fold and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--actuation", choices=("measured", "commanded"), default="measured")
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--judged", default="", help="folds to leave out, as 1,2; default: all")
    parser.add_argument("--members", type=int, default=5)
    parser.add_argument("--epochs", type=int, default=200)
    parser.add_argument("--effects", default="auto")
    parser.add_argument("--prior", default="arcs")
    parser.add_argument("--network", choices=("haw_nn", "kernel", "auto"), default="haw_nn")
    parser.add_argument(
        "--no-recurrent", action="store_true", help="leave out that black box, the slowest"
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        recordings = load_recordings(options.recordings)
    history, spec = (
        history_of(recordings, options.actuation),
        arm_spec(recordings, options.actuation),
    )
    names = tuple(name for name in options.effects.split(",") if name)
    kernel = options.network == "kernel"  # which has no options of its own
    config = FitConfig(
        network=options.network,
        effects=() if kernel else names,
        prior=options.prior,
        members=1 if kernel else options.members,
        epochs=options.epochs,
    )
    group = torch.zeros(history.valid.shape, dtype=torch.long)
    group[history.valid] = dealt(history)
    names = group[history.valid].unique()
    order = names[torch.randperm(len(names), generator=torch.Generator().manual_seed(0))]
    every: dict[str, list[Fold]] = {}
    judged = [int(x) - 1 for x in options.judged.split(",") if x] or range(options.folds)
    for number in judged:
        left_out = torch.isin(group, order[number :: options.folds]) & history.valid
        for fold in judge(history, spec, left_out, config, not options.no_recurrent):
            every.setdefault(fold.name, []).append(fold)
            rmse = np.sqrt(np.nanmean(fold.square_mm2))
            line = f"  fold {number + 1}: {fold.name:20s} {rmse:8.3f} mm"
            if fold.inside is not None:
                inside = fold.inside[~np.isnan(fold.square_mm2)].mean()
                line += f", {inside:.1%} within the 95 % interval"
            print(line, flush=True)
    errors = {
        name: float(np.sqrt(np.nanmean(np.concatenate([f.square_mm2 for f in folds]))))
        for name, folds in every.items()
    }
    for name, rmse in errors.items():
        print(f"{name:20s} {rmse:8.3f} mm on all left-out rows")
    mine = every["this model"]
    best = min(value for name, value in errors.items() if name != "this model")
    print(f"this model / best black box {errors['this model'] / best:.2f}")
    error = torch.from_numpy(np.sqrt(np.concatenate([fold.square_mm2 for fold in mine])))
    radius = torch.from_numpy(np.concatenate([fold.radius_mm for fold in mine]))
    covered = [coverage_of(error[:, [k]], radius[:, [k]]) for k in range(error.shape[1])]
    print(
        f"coverage of the 95 % interval {coverage_of(error, radius):.1%}; "
        "key points base to tip: " + " ".join(f"{share:.1%}" for share in covered)
    )
    each = group_coverage(mine)
    spread = each.std(ddof=1) / np.sqrt(len(each)) if len(each) > 1 else np.nan
    print(
        f"mean over {len(each)} left-out runs or blocks {each.mean():.1%} ± {spread:.1%} (standard "
        f"error), least {each.min():.0%}"
    )


if __name__ == "__main__":
    main()
