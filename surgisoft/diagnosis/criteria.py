"""Every number that decides what a diagnosis names, with its meaning, unit and origin.

Three groups: what the model selection asks of an effect (`SelectionCriteria`), what kind of
result its findings amount to (`DecisionCriteria`), and how sure the result is (`Calibration`). All
were set by hand on virtual robots that `surgisoft benchmark diagnosis` draws (robots 101 to 127,
seeds 1 to 10); the robots whose results are reported are others.

Gains are shares of the held-out squared error above the noise floor. A log gain is the mean over
blocks of time of log(error before / error after), with the noise added to both. Sizes are errors
above the noise floor in units of the model discrepancy, which is the model's validated error.
"""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class SelectionCriteria:
    """What an effect must do on held-out blocks before it is named."""

    # Significance.
    p_value: float = 0.02
    """Largest family-wise p-value, over all effects together, at which an effect is named."""

    # The first effect.
    first_gain: float = 0.25
    """Least gain of the first effect."""
    first_gain_within_discrepancy: float = 0.5
    """Least gain of the first effect where the whole error is within the validated one."""
    log_gain: float = 0.08
    """Least log gain of any effect."""
    large_gain: float = 0.5
    """Gain from which `large_p_value` and `large_log_gain` apply: there are few blocks, or the
    effect shows in some of them only."""
    large_p_value: float = 0.2
    """Largest p-value of a large gain."""
    large_log_gain: float = 0.07
    """Least log gain of a large gain."""
    far_size: float = 1.2
    """Size of the error from which `far_gain` applies, whatever the p-value: few blocks are needed
    to show a support that is seldom touched."""
    far_gain: float = 0.8
    """Least gain where the error is far beyond the model discrepancy."""

    # A further effect: large enough by any one of these.
    next_share: float = 0.15
    """Least share of the first error above the floor that a further effect explains."""
    beside_gain: float = 0.3
    """Or: least gain on top of the effects before it, with the two below."""
    beside_log_gain: float = 0.15
    """Least log gain on top of them."""
    beside_overlap: float = 0.75
    """Most of its stand-alone gain as a share of the first effect's: above it the two are collinear
    and it may only repeat the first."""
    distinct_gain: float = 0.45
    """Or: gain on top of the effects before it that no effect collinear with them reaches."""
    distinct_log_gain: float = 0.45
    """Log gain that goes with `distinct_gain`."""
    nearly_all_gain: float = 0.8
    """Or: gain on top of the effects before it, by itself."""

    # A further effect beside the relaxed forms of those before it.
    own_share: float = 0.06
    """Least share of the first error above the floor that it explains beside the relaxed forms."""
    own_gain: float = 0.3
    """Least gain beside the relaxed forms."""
    own_log_gain: float = 0.08
    """Least log gain beside the relaxed forms."""
    left_beside_relaxed: float = 0.5
    """Or: it leaves at most this share of what the relaxed forms leave."""
    most_effects: int = 3
    """Most effects that one diagnosis names."""
    exchanges: int = 4
    """Most rounds of exchanges."""

    # Lack of fit of the named effects.
    relaxed_worth: float = 0.015
    """Least product of gain and log gain of relaxed forms from which a form is wrong."""
    relaxed_share: float = 0.1
    """Or, however noisy the blocks, their gain by itself."""
    relaxed_p_value: float = 0.02
    """Largest p-value of such a gain."""
    relaxed_spans: int = 4
    """Parts of the recordings in which a relaxed form may have amplitudes of its own."""

    # Competing effects.
    refined_gain: float = 0.6
    """Gain, as a share of the best effect's, from which an effect's nonlinear parameters are fitted
    before it is compared again: to first order and on a grid a large effect loses some of what it
    explains."""
    competing_gain: float = 0.8
    """Gain, as a share of the first effect's, from which an effect can compete with it."""
    win_share: float = 0.9
    """Share of bootstrap samples in which the first effect must beat a competing one."""
    tie_of_gain: float = 0.02
    """Difference of two gains, as a share of the better one, up to which no form is known well
    enough to tell the two effects apart, however sure the blocks are."""
    tie_of_left: float = 0.3
    """The same difference as a share of what the better one leaves; the smaller of both counts."""
    most_competing: int = 3
    """Most competing effects that are refined, and that an experiment is sought for."""

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
        return float(log_gain) * (1.0 - self.amplitude_price * min(amplitudes, self.most_priced))


@dataclass(frozen=True)
class DecisionCriteria:
    """Which kind of result the evidence amounts to."""

    least_size: float = 1.0
    """Least size of the remaining error of an `unknown_effect`: less may be model discrepancy."""
    far_size: float = 1.5
    """Size of the remaining error from which something is missing, whatever it is."""
    above_floor: float = 1.3
    """Factor on the noise floor by which that error must stand out."""
    explained: float = 0.68
    """Gain that the named effects and the next best one must reach together where `far_size` or
    more remains; else something unknown is missing."""
    explained_exactly: float = 0.95
    """The same for effects alone whose form is exact, as that of a turned frame."""
    explained_beside_box: float = 0.6
    """The same where less remains, if the black box explains more by `missed_share`."""
    missed_share: float = 0.2
    """How much more, as a gain, the black box then explains."""
    box_gain: float = 0.05
    """Additional gain of a black box that does so much better than the named effects that they are
    not what is missing."""
    box_log_gain: float = 0.25
    """Log gain of the black box over the named effects that goes with `box_gain`."""
    box_share: float = 0.35
    """Gain of the black box from which something unknown is missing where no effect is named."""
    box_p_value: float = 0.02
    """Largest p-value of a black box that counts."""
    least_motions: int = 10
    """Fewest different motions of which a black box counts: on fewer it learns the model
    discrepancy by heart."""
    discrepancy_size: float = 2.2
    """Most likely size of a static error from which it is more than model discrepancy."""
    undertrained_over_floor: float = 2.0
    """Factor on the noise floor from which an error of the network itself is too much."""
    undertrained_share: float = 0.5
    """Share of the error above the floor that the model discrepancy must hold where the network is
    called undertrained."""
    nearest_gain: float = 0.1
    """Least gain of an effect that is reported as the nearest one to something unknown."""


@dataclass(frozen=True)
class Calibration:
    """A logistic curve: how often such a statement was right.

    Fitted, with a ridge of 1, to 425 statements about virtual robots (robots 104 to 111, drawn as
    seeds 3, 4, 6 and 7 of `benchmarks/diagnosis` draw them), 96 % of which were right. Nearly all
    that were wrong are about robots whose effect is outside the list. The mimicked effects have
    log odds of their own (`Hypothesis.mimic_log_odds`).
    """

    constant: float = 5.38
    """Log odds of a statement."""
    runner_up: float = -1.47
    """Log odds for the runner-up's gain as a share of the first's, limited to 0 to 1.2."""
    relaxed: float = -128.0
    """Log odds for the product of gain and log gain of the relaxed forms."""
    ambiguous: float = 0.81
    """Most confidence where competing effects explain as much: of 21 ambiguous statements 17 were
    right about the first effect."""
    untenable: float = 0.25
    """Confidence below which a single effect is not named."""
    nearest: float = 0.25
    """Most confidence in the effect that is nearest to an unknown one."""


@dataclass(frozen=True)
class Criteria:
    """All that decides what a diagnosis names."""

    selection: SelectionCriteria = field(default_factory=SelectionCriteria)
    decision: DecisionCriteria = field(default_factory=DecisionCriteria)
    calibration: Calibration = field(default_factory=Calibration)


CRITERIA = Criteria()
"""The criteria in force."""
