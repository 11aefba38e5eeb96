"""What identification knows of single effects beyond their physics, by the effect's name.

An effect that is not listed, such as a user-defined one, has the defaults.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class EffectKnowledge:
    """What identification knows of one effect."""

    mimic_log_odds: float = 0.0
    """Log odds of a statement that names it: causes outside the list look like some effects more
    than like others (fitted with `criteria.Calibration`)."""
    absent_in: str = ""
    """Experimental setup in which it cannot act; empty: there is none."""
    own_weight: str = ""
    """Amplitude that the arm's own weight acts by, for a load of gravity; empty: it is none."""
    tip_mass: str = ""
    """Amplitude that a mass at the tip acts by, for a load of gravity."""


EFFECT_KNOWLEDGE: dict[str, EffectKnowledge] = {
    "contact": EffectKnowledge(absent_in="no_support"),
    "coupling": EffectKnowledge(mimic_log_odds=-2.35),
    "gain_mismatch": EffectKnowledge(mimic_log_odds=-2.35),
    "hysteresis": EffectKnowledge(mimic_log_odds=-1.85),
    "line_lag": EffectKnowledge(absent_in="short_tube"),
    "misalignment": EffectKnowledge(absent_in="new_frame"),
    "payload": EffectKnowledge(absent_in="bare_tip", own_weight="body_sag", tip_mass="tip_sag"),
}
"""What is known, by the effect's name."""


def knowledge_of(effect: str) -> EffectKnowledge:
    """What identification knows of an effect; the defaults for one that is not listed."""
    return EFFECT_KNOWLEDGE.get(effect, EffectKnowledge())


def absent_in(setup: str) -> tuple[str, ...]:
    """The effects that cannot act in an experimental setup."""
    return tuple(name for name, known in EFFECT_KNOWLEDGE.items() if known.absent_in == setup)


def gravity_load() -> str:
    """The effect that stands for loads along the weight."""
    return next(name for name, known in EFFECT_KNOWLEDGE.items() if known.own_weight)
