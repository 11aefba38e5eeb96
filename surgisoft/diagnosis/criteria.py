"""The numbers that are not fitted: the reach of the search, and the costs of wrong results.

What a diagnosis names is decided by a fitted model (`decision`); its numbers stand in
`assets/decision/decision.json` with the cases that they were fitted to. Here stand the settings of
the search that proposes effects, generously, to that model, and the costs that its probabilities
are weighed with. None of them is fitted with it; the costs of a wrong name, a needless name and a
wrong "unknown" are those that an earlier fit had chosen, on most of the cases that are reported.
`python -m benchmarks.decision.stated_values` prints what results a halved and a doubled value of
`Claim` and `Worth` changes (docs/results/decision.md).

Gains are shares of what can be explained of the held-out squared error (what lies above the noise
floor). Sizes are errors above the noise floor in units of the model discrepancy, which is the
model's validated error.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Search:
    """How far model selection looks; every effect that is left out of it is no candidate."""

    # Which effects are worth a look.
    p_value: float = 0.2
    """Largest family-wise p-value of an effect that is proposed."""
    large_gain: float = 0.5
    """Or: least gain, whatever the p-value; few blocks may show the effect."""
    pairs: int = 8
    """Pairs of effects whose forms are sought beside each other until nothing is better. With 8 the
    best of all pairs in all forms was found in 75 of 76 recordings with two hidden effects."""

    # Which effects are compared at their optimum.
    refined_gain: float = 0.6
    """Gain, as a share of the best effect's, from which an effect's nonlinear parameters are fitted
    before it is compared again: to first order and on a grid a large effect loses some of what it
    explains."""
    competing_gain: float = 0.8
    """Gain, as a share of the best effect's, from which the lack of fit of an effect is tested."""
    most_refined: int = 3
    """Most effects beside the best one that are refined, and that an experiment is sought for."""
    relaxed_spans: int = 4
    """Parts of the recordings in which a relaxed form may have amplitudes of its own."""

    # Plausibility and simplicity of an effect.
    amplitude_price: float = 0.003
    """Share of a log gain that each amplitude costs: of two that explain alike, the simpler one."""
    most_priced: int = 12
    """Most amplitudes that cost something: many share a ridge, and few of them are free."""
    most_static: float = 0.95
    """Most of what an effect that needs reversals explains that a cubic of the actuation may hold.
    On virtual robots it was 0.1 to 0.8 where friction was hidden, 0.997 and more where sensors saw
    each other's pressures."""
    plausible_factor: float = 2.0
    """Factor by which a first, linear estimate may leave the plausible range of a parameter."""

    def priced(self, log_gain: float, amplitudes: int) -> float:
        """A log gain, the less of it counted the more amplitudes it took."""
        price = self.amplitude_price * min(amplitudes, self.most_priced)
        return float(log_gain) - price * abs(float(log_gain))


@dataclass(frozen=True)
class Worth:
    """Utility of a result to its reader: 1 for a right name, 0 for "cannot tell".

    Stated, not fitted. Costs that every fit chose for itself jumped by a factor of 1.5 from one set
    of sources to another, and with them what was named (docs/results/decision.md).
    """

    needless_name: float = -1.0
    """An effect is named, alone or in a set, and none of the list is missing: `amend` shows on
    held-out data that it does nothing."""
    wrong_name: float = -3.0
    """An effect is named, alone or in a set, and another one of the list is missing; or two are
    named together, and neither of them is missing but another one of the list. It costs most,
    because the wrong effect explains some of the error and may stay in the model."""
    right_set: float = 0.7
    """The missing effect is one of two that are named as a set. A wrong set costs this share of a
    wrong name: its reader makes an experiment, and does not change the model."""
    half_pair: float = 0.25
    """One of two effects that are named together is missing, the other not. Half of
    `first_of_pair`: there a missing effect is left out, here one that is not missing is added.
    `amend` shows that it does nothing."""
    first_of_pair: float = 0.5
    """One effect is named, alone or in a set, and another one is missing too."""
    wrong_unknown: float = -1.4
    """An effect of the list, or none, is called unknown: no model is changed for it, but the effect
    is not found either."""
    wrong_nothing: float = -2.0
    """Something is missing and the result is that nothing is."""
    wrong_network: float = -1.0
    """The model is called off, and something else is missing."""
    least_probability: float = 1.0 / 3.0
    """A statement that is less probable is not made."""


@dataclass(frozen=True)
class Claim:
    """Conditions for the claim "nothing is missing", whatever the fitted probabilities are."""

    near_floor: float = 1.3
    """Most error over the noise floor that counts as near it: a tenth of a floor is how far apart
    estimates of it lie."""
    near_box: float = 1.25
    """Most error over what a black box with memory reaches on held-out blocks."""
    most_over_validated: float = 1.5
    """Most error over the validated error, both with their noise."""


SEARCH = Search()
"""The search in force."""
WORTH = Worth()
"""The worth of results in force."""
CLAIM = Claim()
"""The conditions of "nothing is missing" in force."""
