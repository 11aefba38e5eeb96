"""CONTEXT.toml: the question of interest, the context of use, the model risk and the limits.

ASME V&V 40-2018 leaves these to whoever uses the model: no program can know them.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from surgisoft.config import Rule, Where, from_table, one_of, path_beside, read_toml

LEVELS = ("low", "medium", "high")
"""Levels of model influence and of decision consequence."""

Level = Annotated[str, one_of(LEVELS)]
Text = Annotated[str, Rule("text of 1 to 5000 characters", lambda s: 0 < len(s.strip()) <= 5000)]
Limit = Annotated[float, Rule("a number > 0", lambda value: 0.0 < value <= 1e6)]
Share = Annotated[float, Rule("a share from 0 to 1", lambda value: 0.0 <= value <= 1.0)]
Spread = Annotated[float, Rule("a number from 0", lambda value: 0.0 <= value <= 1e9)]


@dataclass(frozen=True)
class Risk:
    """The model risk: what the decision rests on, and what a wrong one does (V&V 40)."""

    influence: Level
    """Model influence: weight of the model beside other evidence in the decision."""
    consequence: Level
    """Decision consequence: harm of a wrong decision."""
    reason: str = ""
    """Why these levels."""

    @property
    def level(self) -> str:
        """The model risk: the higher of both levels, and medium for low with high."""
        one, other = LEVELS.index(self.influence), LEVELS.index(self.consequence)
        return LEVELS[1] if {one, other} == {0, 2} else LEVELS[max(one, other)]


@dataclass(frozen=True)
class Limits:
    """Acceptance criteria; what is not given is reported and not judged."""

    error_mm: Limit | None = None
    """Largest comparison error plus validation uncertainty of every key point, mm."""
    tip_error_mm: Limit | None = None
    """Largest comparison error plus validation uncertainty of the last key point alone, mm."""
    area_mm: Limit | None = None
    """Largest area metric of every key point, mm."""
    applicable: Share | None = None
    """Least share of the scenario's states inside the validated domain."""


@dataclass(frozen=True)
class Uncertainty:
    """Standard uncertainties (one sigma); what is not given is estimated where that is possible."""

    noise_mm: Spread | None = None
    """Of one coordinate of a measured key point, mm."""
    input: tuple[Spread, ...] = ()
    """Of each actuation channel, in its unit; one value stands for all channels."""
    parameters_mm: Spread | None = None
    """What uncertain parameters of the model do to a key point, RMS distance, mm."""


@dataclass(frozen=True)
class Source:
    """Where a recording comes from."""

    name: Text
    """Name of the recording: its file without the suffix."""
    robot: str = ""
    """Which robot."""
    date: str = ""
    """When it was measured."""
    note: str = ""
    """By whom, with what."""


@dataclass(frozen=True)
class Scenario:
    """Where the model is to be used: the states that the validated domain is compared with."""

    states: tuple[str, ...] = ()
    """Recordings, schedules (CSV), episodes (.npz) or folders of an experiment's results, relative
    to the file."""
    payload_g: tuple[float, ...] = ()
    """Masses that the arm carries there, g; without any as in the files, else unknown."""


@dataclass(frozen=True)
class Context:
    """Content of CONTEXT.toml."""

    question: Text
    """The question of interest: what is to be decided."""
    use: Text
    """The context of use: what the model's result is used for, and within what."""
    risk: Risk
    """Model risk."""
    title: str = ""
    """Title of the report."""
    limits: Limits = field(default_factory=Limits)
    """Acceptance criteria."""
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    """Standard uncertainties as the user knows them."""
    sources: tuple[Source, ...] = ()
    """Robot and date of recordings."""
    scenario: Scenario = field(default_factory=Scenario)
    """States of the scenario."""
    model: str = ""
    """For `experiment run --credibility`: the arm model; default: the scenario's."""
    recordings: tuple[str, ...] = ()
    """For `experiment run --credibility`: recordings of the arm, relative to the file."""

    def checked(self, where: Where) -> "Context":
        """The context, unless a recording is described twice."""
        seen: set[str] = set()
        for number, source in enumerate(self.sources):
            if source.name in seen:
                raise (where / "sources" / number / "name").error(
                    f"a second '{source.name}'", "each recording once"
                )
            seen.add(source.name)
        return self

    def source(self, name: str) -> Source | None:
        """The context's entry for a recording; None where it has none."""
        return next((source for source in self.sources if source.name == name), None)


def load_context(path: str | Path) -> Context:
    """Read CONTEXT.toml; an InputError names file, line and field of what is wrong.

    Paths in it become absolute.
    """
    path = Path(path)
    table, where = read_toml(path)
    context = from_table(Context, table, where)

    def there(text: str, place: Where) -> str:
        return str(path_beside(place, text, "a file or folder"))

    states = tuple(
        there(text, where / "scenario" / "states" / i)
        for i, text in enumerate(context.scenario.states)
    )
    files = tuple(
        there(text, where / "recordings" / i) for i, text in enumerate(context.recordings)
    )
    model = context.model
    if model not in ("", "default"):
        model = there(model, where / "model")
    scenario = replace(context.scenario, states=states)
    return replace(context, scenario=scenario, recordings=files, model=model)
