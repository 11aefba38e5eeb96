"""Which kind of answer the findings of a diagnosis amount to."""

from collections.abc import Sequence

from surgisoft.diagnosis.race.naming import CHANCE
from surgisoft.diagnosis.verdict import Kind
from surgisoft.surrogate.effects import hypothesis_of, known_effects

LEAST_LEFT = 1.0
"""Factor on the surrogate's validated error that is left wherever something unknown is told: what
is less may be the surrogate's own."""
LEAST_EXPLAINED = 0.68
"""Share of the error above the floor that the named effects and the next best one must explain
where FAR or more is left; else something that is not known is missing."""
LEAST_SETTLED = 0.95
"""The same of effects alone that real arms have in this very form (`Hypothesis.exact_form`)."""
EXPLAINED, MISSED_SHARE = 0.6, 0.2
"""The same wherever something is left, where they explain so much less, of the error above the
floor, than a black box does."""
BETTER_BOX = (0.05, 0.25)
"""From when on a black box does so much better than the named effects that they are not what is
missing: share of the error above the floor that it explains besides, and mean fall of a block's log
error."""
UNKNOWN_SHARE = 0.35
"""Share of the error above the floor that a black box must explain where no effect does."""
OFF_SIZE = 2.2
"""Factor on the validated error from which a static error is more than the surrogate's own."""
FAR, ABOVE = 1.5, 1.3
"""Factor on the validated error that is left from which something is missing, whatever it is, and
factor on the floor by which the error must stand out from the noise."""
LEAST_MOTIONS = 10
"""Fewest different motions of which a black box may say that something is missing: on fewer it
knows the surrogate's own error by heart."""
TRAINED = 2.0
"""Factor on the floor from which an error of the surrogate's own is too much."""


def kind_of(
    names: tuple[str, ...], rivals: Sequence[str], further: float, wrong: bool, numbers: dict
) -> tuple[Kind, tuple[str, ...]]:
    """The kind of the answer and the effects that it names.

    names: effects that passed the gates; rivals: those that do as well as the one; further: share
    of what the named ones leave that the next best explains; wrong: whether the named ones' forms
    are not those of what is missing; numbers: the statistics of the diagnosis.
    """
    if not names:
        return unnamed(numbers), ()
    beyond = numbers["left_size"] >= LEAST_LEFT
    if wrong or (beyond and _imitated(names, further, numbers)):
        return "unknown_effect", ()
    if rivals and len(names) == 1:
        return "ambiguous", (names[0], *rivals)
    return ("several" if len(names) > 1 else "identified"), names


def unnamed(numbers: dict) -> Kind:
    """The kind of an answer that names no effect."""
    over = numbers["before_over_floor"]
    if over >= ABOVE and numbers["left_size"] >= FAR:
        return "unknown_effect"
    if over >= TRAINED:
        beyond = numbers["left_size"] >= LEAST_LEFT
        box = numbers["box_share"] >= UNKNOWN_SHARE and _sure_of_box(numbers)
        if beyond and (box or numbers["static_size"] >= OFF_SIZE):
            return "unknown_effect"
        if numbers["static_share"] >= 0.5:
            return "surrogate_undertrained"
    return "nothing_missing"


def _imitated(names: tuple[str, ...], further: float, numbers: dict) -> bool:
    """Whether the named effects explain too little, or a black box far more."""
    explained = numbers["explained_above_floor"]
    together = explained + max(further, 0.0) * (1.0 - explained)
    beaten = numbers["box_share"] - explained
    sure = _sure_of_box(numbers)
    if numbers["left_size"] >= FAR:
        settled = all(hypothesis_of(known_effects()[name]).exact_form for name in names)
        if together < LEAST_EXPLAINED or (settled and explained < LEAST_SETTLED):
            return True
    if together < EXPLAINED and sure and beaten >= MISSED_SHARE:
        return True
    share, log_gain = BETTER_BOX
    return sure and beaten >= share and numbers["box_log_gain"] >= log_gain


def _sure_of_box(numbers: dict) -> bool:
    """Whether what a black box explains is more than chance and seen in motions enough."""
    return numbers["box_p"] <= CHANCE and numbers["motions"] >= LEAST_MOTIONS
