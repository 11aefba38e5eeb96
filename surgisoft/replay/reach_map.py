"""The reachability map of a scene: which surface around the lesion the laser reaches."""

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from surgisoft.errors import InputError
from surgisoft.files import check_folder, write_atomically
from surgisoft.scene.check import REASONS, Patch, SceneCheck, sentence
from surgisoft.scene.folder import Scene
from surgisoft.scene.mounted_arm import RingSolution, ring_moments

REASON_COLOURS = ("#2a9d4a", "#00a5b5", "#e08a1e", "#a02bb8", "#c1121f", "#1d5fa8")
"""Colour of each reason, in the order of REASONS; the incidence is drawn in shades of grey."""

HEADING_PAD_IN = 0.1
"""Space above and below each part of the picture (inches): the heading stays off the titles."""


def check_map(scene: Scene, path: Path) -> None:
    """Raise InputError where the map of a scene cannot be drawn to a file, whatever its verdict."""
    if path.suffix.lower() != ".png":
        raise InputError(f"{path}: suffix '{path.suffix}', expected .png")
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a file to write")
    if not scene.spec.arms_with("laser"):
        raise InputError("no arm of the scene carries a laser, so there is no map to draw")
    check_folder(path.absolute().parent)


def draw_reach_map(
    scene: Scene, verdict: SceneCheck, patches: Mapping[str, Patch], path: Path
) -> None:
    """Write a .png: each laser's patch coloured by the beam's incidence, and values on the ring."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    path, work = Path(path), verdict.work
    check_map(scene, path)
    if work is None:
        raise InputError("the ring does not lie on the organ, so there is no map to draw")
    layout = ConstrainedLayoutEngine(h_pad=HEADING_PAD_IN)
    figure = Figure(figsize=(12.0, 5.6 * len(patches)), layout=layout)
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(patches), 2, width_ratios=(1.0, 1.15), squeeze=False)
    for number, ((name, patch), (left, right)) in enumerate(
        zip(patches.items(), grid, strict=True)
    ):
        whose = "" if len(patches) == 1 else f" ({name})"
        _draw_patch(figure, left, scene, work.reasons[name], patch, whose)
        rows = right.get_subplotspec().subgridspec(3, 1)
        right.remove()
        axes = [figure.add_subplot(row) for row in rows]
        order = ring_moments(len(work.clearance_mm), len(patches))[:, number]
        clearance_mm = np.empty_like(work.clearance_mm)
        clearance_mm[order] = work.clearance_mm
        _draw_ring(axes, scene, work.reasons[name], work.cuts[name], clearance_mm, whose)
    figure.suptitle(f"{scene.spec.name}: {sentence(verdict)}", fontsize=9, wrap=True)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_atomically(path, buffer.getvalue())


def _draw_patch(figure, axes, scene: Scene, reason: np.ndarray, patch: Patch, whose: str) -> None:
    from matplotlib.tri import Triangulation

    triangles = Triangulation(*patch.flat_mm.T)
    worst = scene.spec.laser.max_incidence_deg
    shown = axes.tripcolor(
        triangles,
        np.degrees(patch.incidence_rad),
        shading="gouraud",
        cmap="Greys",
        vmin=0.0,
        vmax=worst,
    )
    figure.colorbar(shown, ax=axes, label="incidence of the beam (degrees)", shrink=0.85)
    for code in np.unique(patch.reason[patch.reason > 0]):
        bad = patch.flat_mm[patch.reason == code]
        axes.scatter(
            *bad.T,
            s=26,
            marker="s",
            color=REASON_COLOURS[code],
            edgecolors="white",
            linewidths=0.6,
            label=REASONS[code],
        )
    closed = np.vstack((patch.ring_flat_mm, patch.ring_flat_mm[:1]))
    axes.plot(*closed.T, color="black", lw=5.0)
    axes.plot(*closed.T, color="white", lw=3.5)
    for code in np.unique(reason):
        here = reason == code
        axes.scatter(
            *patch.ring_flat_mm[here].T,
            s=14,
            color=REASON_COLOURS[code],
            label=f"ring: {REASONS[code]} ({100 * here.mean():.0f} %)",
            zorder=3,
        )
    axes.set(aspect="equal", xlabel="mm", ylabel="mm")
    axes.set_title(f"surface around the lesion{whose}", fontsize=9)
    axes.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=3, frameon=False)


def _draw_ring(
    axes,
    scene: Scene,
    reason: np.ndarray,
    cut: RingSolution,
    clearance_mm: np.ndarray,
    whose: str,
) -> None:
    """Clearance, incidence and length of the beam over the angle around the ring."""
    angle = 360.0 * np.arange(len(reason)) / len(reason)
    limits, laser = scene.spec.limits, scene.spec.laser
    rows = (
        ("clearance (mm)", clearance_mm, (limits.clearance_mm,)),
        ("incidence (deg)", np.degrees(cut.incidence_rad), (laser.max_incidence_deg,)),
        ("beam length (mm)", cut.standoff_mm, laser.standoff_mm),
    )
    for one, (label, values, bounds) in zip(axes, rows, strict=True):
        one.plot(angle, values, color="#333333", lw=1.2)
        colours = [REASON_COLOURS[code] for code in reason]
        one.scatter(angle, values, s=9, c=colours, zorder=3)
        for bound in bounds:
            one.axhline(bound, color="#c1121f", lw=0.9, ls="--")
        one.set(ylabel=label, xlim=(0.0, 360.0), xticks=range(0, 361, 60))
        one.grid(alpha=0.3)
        if one is not axes[-1]:
            one.set_xticklabels([])
    axes[0].set_title(f"around the ring{whose} (dashed: the scene's limits)", fontsize=9)
    axes[-1].set_xlabel("angle around the ring (degrees)")
