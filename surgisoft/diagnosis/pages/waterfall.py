"""The waterfall of a falling error: from the model as it was, effect by effect, to the floor."""

from pathlib import Path

from surgisoft.report import Picture
from surgisoft.report.charts import BLUE, GREEN, RED, chart, drawing
from surgisoft.report.style import MUTED

CAPTION = "Error on the locked part, after each step; dashed: noise floor of the measurement"


def waterfall(before_mm: float, steps: list[tuple[str, float]], floor_mm: float):
    """A Matplotlib figure; steps: (name, error after it in mm). Draw inside `drawing`."""
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(1.6 + 1.1 * (len(steps) + 2), 3.2))
    axis.bar(0, before_mm, color=RED, width=0.7)
    level, place, names = before_mm, 0, ["before"]
    axis.text(0, before_mm, f"{before_mm:.3f}", ha="center", va="bottom")
    for place, (name, after) in enumerate(steps, 1):
        rises = after > level
        axis.bar(place, after - level, bottom=level, color=RED if rises else GREEN, width=0.7)
        axis.plot([place - 1.35, place + 0.35], [level, level], c=MUTED, lw=0.8)
        axis.text(place, max(level, after), f"{after - level:+.3f}", ha="center", va="bottom")
        level = after
        names.append(name.replace("_", "\n"))
    axis.bar(len(steps) + 1, level, color=BLUE, width=0.7)
    axis.text(len(steps) + 1, level, f"{level:.3f}", ha="center", va="bottom")
    axis.plot([place + 0.65, len(steps) + 1.35], [level, level], c=MUTED, lw=0.8)
    axis.axhline(floor_mm, c=MUTED, ls="--", lw=1)
    axis.text(len(steps) + 1.45, floor_mm, "floor", c=MUTED, va="bottom")
    axis.set_xlim(-0.5, len(steps) + 1.9)
    axis.set_axisbelow(True)
    axis.set_xticks(range(len(names) + 1), [*names, "after"])
    axis.grid(visible=False, axis="x")
    axis.set_ylabel("error [mm]")
    axis.set_ylim(0, 1.1 * max(before_mm, *(after for _, after in steps)))
    return figure


def waterfall_picture(before_mm: float, steps: list[tuple[str, float]], floor_mm: float) -> Picture:
    """The waterfall for a page."""
    with drawing():
        return chart(waterfall(before_mm, steps, floor_mm), CAPTION, CAPTION)


def write_waterfall(
    before_mm: float, steps: list[tuple[str, float]], floor_mm: float, path: Path
) -> Path:
    """The waterfall as a PNG on white."""
    from matplotlib import pyplot as plt

    path.parent.mkdir(parents=True, exist_ok=True)
    with drawing():
        figure = waterfall(before_mm, steps, floor_mm)
        figure.savefig(path, dpi=160, facecolor="white")
        plt.close(figure)
    return path
