"""How identification tries an effect: candidate parameters, combinations and criteria.

A file of an effect ends with its `HYPOTHESIS`. An effect without one is tried as it is built by
default; `hypothesis_of` then also reads the class attributes that older user-defined effects have.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from surgisoft.surrogate.effects.base import ArmFacts, Effect


def all_together(some: list[Effect]) -> list[list[int]]:
    """One combination of all candidates, as for a spectrum of time constants."""
    return [list(range(len(some)))]


def no_combinations(some: list[Effect]) -> list[list[int]]:
    """No combination, for an effect of which several candidates at once make no sense."""
    return []


MeasuredBody = Literal["", "gain", "load"]
"""Ways in which an effect may act on a measured body, see `Hypothesis.measured_body`."""
Memory = Literal["", "time", "path"]
"""What an effect that `fit` may add by itself depends on, see `Hypothesis.memory`."""


@dataclass(frozen=True)
class Hypothesis:
    """How identification tries an effect that a model may lack."""

    effect: type[Effect]
    """The effect's class."""
    grid: Callable[[ArmFacts, Tensor], list[Effect]] | None = None
    """Gives effects of zero amplitude over a coarse grid of the nonlinear parameters, from what is
    known of the arm and the predicted key points (S, n, 3) in mm of the recordings, base frame.
    None: the effect as its class builds it by default."""
    grid_further: Callable[[ArmFacts, Tensor], list[Effect]] | None = None
    """Gives effects of zero amplitude for a model that has the effect already: effects that add up
    with any other of the kind. None: there can only be more or less of the present one."""
    combinations: Callable[[list[Effect]], list[list[int]]] = all_together
    """Sets of candidates, by number, that are also tried side by side."""
    needs_reversals: bool = False
    """Whether the effect can only be learned from data with inner reversals."""
    exact_form: bool = False
    """Whether real arms have exactly this formula, as with a rotated frame. Then the
    effect must explain more before it is named, because nothing but noise may be left of it."""
    by_definition: bool = False
    """Whether the effect is its formula by definition, as a constant factor or a rotated frame. If
    its amplitude depends on the state or the time, it is another effect; of others the formula is
    an approximation, which many recordings refute though the name is right."""
    moves_base: bool = False
    """Whether the effect turns and shifts the whole body, from the beginning or gradually, as a
    camera frame or a holder does. It is then compared with a turn at one moment (a knock)."""
    needs_motion: bool = False
    """Whether the effect shows only while the actuation moves or shortly after, as a lag does:
    steady-state samples cannot show it."""
    like_a_line: bool = False
    """Whether the effect acts behind the line, and a lag of the line would do nearly the same."""
    absent_in: str = ""
    """Experimental setup (`diagnosis.design.schedules.SETUPS`) in which the effect cannot act;
    empty: there is none."""
    own_weight: str = ""
    """Amplitude by which the weight of the arm acts, for an effect that is a load along gravity;
    empty: the effect is no such load."""
    tip_mass: str = ""
    """Amplitude by which a mass at the tip acts, for an effect that is a load along gravity."""
    memory: Memory = ""
    """Whether `fit --effects auto` tries the effect, and what its memory depends on: `time`, which
    takes recordings with a clock, or `path`, the order of the actuations alone, which steady-state
    samples show as well. Empty: `auto` does not try it."""
    measured_body: MeasuredBody = ""
    """What the effect does to a body that was measured before a change: `gain` scales its whole
    motion, `load` pulls it along gravity, at rest and in motion. Empty: it is tried on the
    predicted body only."""

    def candidates(self, facts: ArmFacts, points: Tensor) -> list[Effect]:
        """Effects of zero amplitude to try on an arm whose model lacks the effect.

        points: (S, n, 3) predicted key points of the recordings, mm, base frame.
        """
        return [self.effect(facts)] if self.grid is None else self.grid(facts, points)

    def further(self, facts: ArmFacts, points: Tensor) -> list[Effect]:
        """Effects of zero amplitude to try on an arm whose model has the effect already."""
        return [] if self.grid_further is None else self.grid_further(facts, points)


def hypothesis_of(effect: Effect | type[Effect]) -> Hypothesis:
    """The hypothesis of an effect or its class.

    The `HYPOTHESIS` of the effect's file, if there is one. Otherwise it is built from the class
    attributes `candidates`, `further`, `together`, `side_by_side`, `needs_reversals` and
    `settled_form`, as far as the class has them.
    """
    kind = effect if isinstance(effect, type) else type(effect)
    stated = getattr(sys.modules.get(kind.__module__), "HYPOTHESIS", None)
    if isinstance(stated, Hypothesis) and stated.effect is kind:
        return stated
    side_by_side = all_together if getattr(kind, "side_by_side", True) else no_combinations
    return Hypothesis(
        kind,
        getattr(kind, "candidates", None),
        getattr(kind, "further", None),
        getattr(kind, "together", side_by_side),
        bool(getattr(kind, "needs_reversals", False)),
        bool(getattr(kind, "settled_form", False)),
    )
