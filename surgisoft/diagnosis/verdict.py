"""What a diagnosis says, for a person and as JSON."""

from dataclasses import asdict, dataclass, field
from typing import Literal

Kind = Literal[
    "identified",
    "several",
    "ambiguous",
    "nothing_missing",
    "unknown_effect",
    "surrogate_undertrained",
]


@dataclass(frozen=True)
class Verdict:
    """The answer in short."""

    kind: Kind
    """One of the six answers."""
    effects: tuple[str, ...]
    """The missing effects, the surest first; the rivals where they cannot be told apart."""
    sentence: str
    """The same in words."""


@dataclass(frozen=True)
class ErrorLevels:
    """RMS distances of a key point, mm."""

    before: float
    """Of the model as it is, on the rows that were looked at."""
    floor: float
    """The noise floor."""
    ceiling: float
    """What the effects that were found, or a black box, would leave on held-out blocks."""


@dataclass(frozen=True)
class Ranked:
    """One effect and how well it explains what is left."""

    effect: str
    """Its name."""
    confidence: float
    """Calibrated chance that it is missing, 0 to 1."""
    gain_alone: float
    """Share of the held-out squared error above the floor that goes with this effect alone."""
    gain_unique: float
    """Share that comes back when it is left out of all effects together."""
    heldout_rmse_mm: float
    """Held-out error with this effect and the surrogate's own error, mm."""
    ci95: tuple[float, float]
    """95 % interval of that, by blocks, mm."""
    p_value: float
    """Chance of such a gain in any of the effects if none were missing."""
    log_gain: float
    """Mean fall of the log error of a block."""
    parameters: dict
    """Its parameters with units in their names."""


@dataclass(frozen=True)
class Experiment:
    """What to record next."""

    name: str
    """Its name."""
    minutes: float
    """Time on the bench, minutes."""
    separates: tuple[tuple[str, str], ...]
    """Pairs of effects that it tells apart."""


@dataclass(frozen=True)
class Diagnosis:
    """Everything that a diagnosis found."""

    verdict: Verdict
    error_mm: ErrorLevels
    ranking: tuple[Ranked, ...]
    """All effects, the likeliest first."""
    ambiguous_with: tuple[str, ...] = ()
    """Effects that explain the data as well as the first."""
    next_experiment: Experiment | None = None
    """What would tell the rivals apart; None where nothing is open."""
    checks: tuple[str, ...] = ()
    """What is wrong or weak with the data, said before anything is named."""
    notes: tuple[str, ...] = ()
    """Recordings under another direction of gravity, or beyond the range of the model's fit."""
    axis: str | None = None
    """The axis that what is left depends on most, where it is known."""
    seconds: float = 0.0
    """Time that it took, s."""
    statistics: dict = field(default_factory=dict)
    """What the decision was made from."""

    def to_json(self) -> dict:
        """Plain values, as `diagnose --json` writes them."""
        return asdict(self)


def sentence_of(
    kind: Kind,
    effects: tuple[str, ...],
    levels: ErrorLevels,
    reached: float,
    sure: float,
    nearest: str | None,
) -> str:
    """The verdict in words.

    reached: held-out error with the named effects, mm; sure: confidence in the first of them;
    nearest: effect that comes nearest to something unknown, None where none comes near.
    """
    error = f"error {levels.before:.3g} mm, floor {levels.floor:.3g} mm"
    if kind == "identified":
        return (
            f"{effects[0]} is missing (confidence {sure:.2f}): with it {reached:.3g} mm remain on "
            f"held-out blocks; {error}"
        )
    if kind == "several":
        together = " and ".join(effects)
        return (
            f"{together} are missing (confidence {sure:.2f} in the first): with them "
            f"{reached:.3g} mm remain on held-out blocks; {error}"
        )
    if kind == "ambiguous":
        return (
            f"cannot tell {' from '.join(effects)} with these recordings: each would leave about "
            f"{reached:.3g} mm on held-out blocks; {error}"
        )
    if kind == "unknown_effect":
        return (
            f"something is missing and it is none of the known effects "
            f"({f'{nearest} comes nearest' if nearest else 'none comes near'}); {error}"
        )
    if kind == "surrogate_undertrained":
        return (
            f"the network itself is off (its validated error says so too): fit it longer or to "
            f"more data before looking for effects; {error}"
        )
    return f"nothing is missing that these recordings could show; {error}"
