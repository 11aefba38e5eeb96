"""Tables and pictures of the benchmark `hidden-effect`."""

from __future__ import annotations

from pathlib import Path

from benchmarks.hidden_effect.policies import SIGHTS, TASK
from benchmarks.hidden_effect.study import CASES, MODELS, Outcome, StudyConfig
from surgisoft.diagnosis.estimation.intervals import values_text
from surgisoft.report.charts import BLUE, GREEN, RED, drawing
from surgisoft.report.style import MUTED

FORMS = {
    "line_lag": "The rig's tube and the model's line have different laws of flow. The model's "
    "parameters were fitted where the error is largest, which is in fast motion. On the circle, "
    "which is slow motion, the model's lag differs from the rig's."
}
"""How the form of an effect in the rig differs from its form in the model, where it matters."""
COLOURS = {"before": RED, "after": GREEN, "oracle": BLUE}
"""Colours of the three models, in every picture."""
WORDS = {
    "blind": "without cameras (`--no-cameras`): only the model estimates the body's position",
    "cameras": "with cameras, so that the state observer corrects the model by measured key points",
}
"""Meaning of each kind of sight."""


def markdown(outcomes: list[Outcome], config: StudyConfig) -> str:
    """All tables as Markdown."""
    parts = [_setting(outcomes, config), "## The model", _models(outcomes), *_verdicts(outcomes)]
    parts.append("## The policy")
    for sight in SIGHTS:
        parts += [f"On the rig, {WORDS[sight]}.", _driven(outcomes, sight)]
    parts += ["### Effect of retraining", "\n".join(_brought(outcomes)), *_why(outcomes)]
    parts.append(_costs(outcomes))
    return "\n\n".join(parts) + "\n"


def _setting(outcomes: list[Outcome], config: StudyConfig) -> str:
    names = [o.case for o in outcomes if CASES[o.case].hidden]
    hidden = f" {', '.join(names)}: switched on in the rig with amplitude {config.strength:g} "
    hidden += "after the model was fitted."
    own = " hysteresis: the friction that every arm of the rig has. The model that lacks it is "
    own += "HAW-NN on pressure alone; the oracle is HAW-NN fitted with the effect to the same "
    own += "steady-state samples."
    return (
        f"Robot {config.robot_seed} of the virtual rig."
        + (hidden if names else "")
        + (own if any(not CASES[o.case].hidden for o in outcomes) else "")
        + f" Each model is diagnosed and amended on one `mixed` recording of "
        f"{config.samples / 1200:g} minutes. The model `after` has the effect that the diagnosis "
        "named first, right or wrong. The oracle is given the name of the effect and three such "
        "recordings. All models are evaluated on another `mixed` recording. "
        f"Policies: `{TASK}`, preset `fast`, {config.steps:,} steps each, seed {config.seed}; "
        f"{config.episodes} episodes of each policy on the rig. The centre of the circle is the "
        "tip's position at 20 kPa by the policy's own model, so it differs between models. With "
        "one robot and one seed, differences of a few hundredths of a millimetre between policies "
        "mean nothing."
    )


def _models(outcomes: list[Outcome]) -> str:
    """Verdicts and errors of the models."""
    lines = [
        "| hidden | verdict | added | before | after | oracle | floor "
        "| fall after (95 %) | share of the oracle's fall |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for o in outcomes:
        e, fall = o.model_mm, o.falls["after"]
        low, high = fall["ci95"]
        share = (e["before"] - e["after"]) / (e["before"] - e["oracle"])
        verdict = " -> ".join(_verdict(v) for v in o.verdicts)
        lines.append(
            f"| {o.case} | {verdict} | {' + '.join(o.amended) or 'nothing'} | "
            + " | ".join(f"{e[key]:.3f}" for key in (*MODELS, "floor"))
            + f" | {fall['fall']:.3f} ({low:.3f} to {high:.3f}) | {100 * share:.0f} % |"
        )
    lines += [
        "",
        "RMS distance of a key point in mm, on a recording not used for the fit.",
    ]
    return "\n".join(lines)


def _verdict(result: dict) -> str:
    verdict = result["verdict"]
    sure = result["ranking"][0]["confidence"] if result["ranking"] else 0.0
    names = ", ".join(verdict["effects"])
    return f"{verdict['kind']}: {names} ({sure:.2f})" if names else verdict["kind"]


def _verdicts(outcomes: list[Outcome]) -> list[str]:
    """Verdict on each effect, in words."""
    paragraphs = []
    for o in outcomes:
        lines = [f"**{o.case}**"]
        lines += [f"- diagnose: {result['verdict']['sentence']}" for result in o.verdicts[:1]]
        if o.experiment:
            plan = o.experiment
            pairs = ", ".join(" from ".join(pair) for pair in plan["separates"]) or "no pair surely"
            lines.append(
                f"- next experiment: {plan['name']}, {plan['minutes']:g} minutes, expected to "
                f"distinguish {pairs}; recorded on the rig"
            )
            lines.append(f"- diagnose with it: {o.verdicts[-1]['verdict']['sentence']}")
            if o.verdicts[-1]["verdict"]["kind"] == "ambiguous":
                lines.append("- still ambiguous: the first of the two is added")
        lines.append(f"- amend: {o.claim}")
        for p in o.parameters:
            low, high = (values_text(end) for end in p["ci95"])
            unit = f" {p['unit']}" if p["unit"] else ""
            value = values_text(p["value"])
            lines.append(f"- {p['effect']} {p['name']}: {value}{unit} ({low} to {high})")
        paragraphs.append("\n".join([lines[0], "", *lines[1:]]))
    return paragraphs


def _driven(outcomes: list[Outcome], sight: str) -> str:
    """Tracking errors of all policies."""
    lines = [
        "| hidden | policy before | policy after | policy, oracle "
        "| scripted before | scripted after | scripted, oracle | random |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for o in outcomes:
        cells = [
            _interval(o.driven[f"{key}/{policy}/{sight}"])
            for policy in ("learned", "scripted")
            for key in MODELS
        ]
        cells.append(f"{o.driven[f'before/random/{sight}']['mean']:.1f}")
        lines.append(f"| {o.case} | " + " | ".join(cells) + " |")
    lines += ["", "Mean distance of the tip from its target in mm, 95 % interval over episodes."]
    return "\n".join(lines)


def _interval(found: dict) -> str:
    return f"{found['mean']:.3f} ({found['low']:.3f} to {found['high']:.3f})"


def _brought(outcomes: list[Outcome]) -> list[str]:
    """For each effect what the retrained policy gained or lost, as the intervals allow it."""
    lines = []
    for o in outcomes:
        for sight in SIGHTS:
            before, after = (o.driven[f"{key}/learned/{sight}"] for key in ("before", "after"))
            change = 1.0 - after["mean"] / before["mean"]
            if after["high"] < before["low"]:
                what = f"reduces the error by {100 * change:.0f} %"
            elif after["low"] > before["high"]:
                what = f"increases the error by {-100 * change:.0f} %"
            else:
                what = f"changes the error by {-100 * change:+.0f} %, which is not significant"
            lines.append(
                f"- {o.case}, {'no cameras' if sight == 'blind' else 'cameras'}: retraining on the "
                f"amended model {what} ({before['mean']:.3f} to {after['mean']:.3f} mm)"
            )
    return lines


def _why(outcomes: list[Outcome]) -> list[str]:
    """Where a policy got worse: whether the arm trails the models, by the rate of actuation."""
    paragraphs = []
    for o in outcomes:
        if o.paced is None:
            continue
        lines = [
            f"**Why the error increases with {o.case}.** Delay of the arm relative to the model "
            "(negative: the model is late) and the model's error, on the test recording:",
            "",
            "| fastest chamber, kPa/s | rows | " + " | ".join(f"{key}" for key in MODELS) + " |",
            "|---|---|" + "---|" * len(MODELS),
        ]
        for band in o.rates:
            cells = [
                f"{band[key]['trails_s']:+.3f} s, {band[key]['rmse_mm']:.3f} mm" for key in MODELS
            ]
            span = f"{band['low']:g} to {band['high']:g}"
            lines.append(f"| {span} | {band['rows']} | " + " | ".join(cells) + " |")
        paragraphs.append("\n".join(lines))
        if o.case in FORMS:
            paragraphs.append(FORMS[o.case])
        found = o.paced["driven"]
        cells = [
            f"{policy} {_interval(found[f'{policy}/{sight}'])} mm {word}"
            for sight, word in (("blind", "without cameras"), ("cameras", "with them"))
            for policy in ("learned", "scripted")
            if f"{policy}/{sight}" in found
        ]
        values = ", ".join(
            f"{p['name']} {values_text(p['value'])} {p['unit']}".strip()
            for p in o.paced["parameters"]
        )
        paragraphs.append(
            "**Amended with motion as slow as the task's.** The same effect was fitted to an "
            f"equally long recording of slow circles: {o.paced['claim']} ({values}). On the mixed "
            f"test recording, which is faster, the error of this model is "
            f"{o.paced['mixed_mm']:.3f} mm. Policy trained on this model and scripted expert, on "
            f"the rig: {'; '.join(cells)}."
        )
    return paragraphs


def _costs(outcomes: list[Outcome]) -> str:
    each = [cost for o in outcomes for cost in o.training.values()]
    cpu = sum(cost["cpu_s"] for cost in each) / len(each)
    wall = sum(cost["wall_s"] for cost in each) / len(each)
    return (
        f"Training of a policy took {cpu:.0f} s of processor time ({wall:.0f} s of wall time on "
        "shared cores) on average. Effects that start from the same model share the policy before."
    )


def draw(outcomes: list[Outcome], folder: Path) -> list[Path]:
    """Draw error bars of models and policies; returns the paths of the pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    tracking = {
        sight: {key: [o.driven[f"{key}/learned/{sight}"] for o in outcomes] for key in MODELS}
        for sight in SIGHTS
    }
    return [_draw_models(outcomes, folder), _draw_tracking(outcomes, tracking, folder)]


def _draw_models(outcomes: list[Outcome], folder: Path) -> Path:
    from matplotlib import pyplot as plt

    with drawing():
        figure, axis = plt.subplots(figsize=(6.4, 3.4))
        for k, key in enumerate(MODELS):
            heights = [o.model_mm[key] for o in outcomes]
            ends = None
            if key in outcomes[0].falls:
                falls = [(o.falls[key]["fall"], *o.falls[key]["ci95"]) for o in outcomes]
                ends = [
                    [high - fall for fall, _, high in falls],
                    [fall - low for fall, low, _ in falls],
                ]
            _bars(axis, k, heights, ends, key)
        for place, o in enumerate(outcomes):
            axis.plot([place - 0.42, place + 0.42], [o.model_mm["floor"]] * 2, c=MUTED, ls="--")
        axis.plot([], [], c=MUTED, ls="--", label="noise floor")
        axis.set_ylabel("model error [mm]\n(bars: 95 % of the fall)")
        axis.legend(ncols=4, loc="upper center", bbox_to_anchor=(0.5, 1.16))
        _name(axis, outcomes)
        return _saved(figure, folder / "hidden_model.png")


def _draw_tracking(outcomes: list[Outcome], tracking: dict, folder: Path) -> Path:
    from matplotlib import pyplot as plt

    with drawing():
        figure, axes = plt.subplots(1, 2, figsize=(9.6, 3.6))
        for axis, sight in zip(axes, SIGHTS, strict=True):
            for k, (key, found) in enumerate(tracking[sight].items()):
                means = [each["mean"] for each in found]
                ends = [
                    [each["mean"] - each["low"] for each in found],
                    [each["high"] - each["mean"] for each in found],
                ]
                _bars(axis, k, means, ends, f"policy {key}", 2 if sight == "blind" else 3)
            scripted = [o.driven[f"after/scripted/{sight}"]["mean"] for o in outcomes]
            axis.plot(range(len(outcomes)), scripted, "k_", ms=22, label="scripted after")
            axis.set_title("model alone" if sight == "blind" else "with cameras")
            axis.set_ylabel("tracking error on the rig [mm]")
            _name(axis, outcomes)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=4, loc="outside upper center")
        return _saved(figure, folder / "hidden_tracking.png")


def _bars(axis, k: int, heights, ends, label: str, decimals: int = 2) -> None:
    places = [place + 0.28 * (k - 1) for place in range(len(heights))]
    key = label.removeprefix("policy ")
    axis.bar(places, heights, 0.26, yerr=ends, color=COLOURS[key], label=label, capsize=2)
    for x, height in zip(places, heights, strict=True):  # at the foot, clear of the error bars
        at = {"xytext": (0, 2), "textcoords": "offset points", "ha": "center"}
        axis.annotate(f"{height:.{decimals}f}", (x, 0), **at, fontsize=6.5, color="white")


def _name(axis, outcomes: list[Outcome]) -> None:
    axis.set_xticks(range(len(outcomes)), [o.case for o in outcomes])
    axis.grid(visible=False, axis="x")
    axis.set_axisbelow(True)
    axis.margins(y=0.15)


def _saved(figure, path: Path) -> Path:
    from matplotlib import pyplot as plt

    figure.savefig(path, dpi=130, facecolor="white")
    plt.close(figure)
    return path
