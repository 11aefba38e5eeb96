"""Which effects the gates let through: forward, exchanged where another fits better, and back."""

from surgisoft.diagnosis.race.form import beside_loose
from surgisoft.diagnosis.race.ranking import Race, Standing, picked_by

CHANCE = 0.02
"""Largest chance, over all effects together, at which an effect is named."""
LARGE = (0.2, 0.5, 0.07)
"""Largest chance at which a large gain is taken all the same (few blocks, or an effect that shows
in some of them only), the share that makes it large, and its least log gain."""
FAR = (1.2, 0.8)
"""Or, whatever its chance, where the error is far beyond the surrogate's own: factor on the
validated error, and share. Few blocks are needed to show a support that is seldom met."""
LEAST_GAIN = 0.25
"""Least share of the squared error above the floor that the first effect explains."""
NEXT_GAIN = 0.15
"""Least share of the first such error that a further effect explains."""
BESIDE = (0.3, 0.15, 0.75)
"""Or: least share of what the effects before it left, least log gain, and the most that it explains
alone beside what the first one does alone, for it must not be that one's shadow."""
NEARLY_ALL = 0.8
"""Or: share of what the effects before it left that no shadow explains."""
NO_SHADOW = (0.45, 0.45)
"""Or: share of what the effects before it left, and log gain, that no shadow of theirs reaches."""
SMALL = 0.5
"""LEAST_GAIN where the whole error is within the surrogate's validated one."""
LEAST_LOG_GAIN = 0.08
"""Least mean fall of the log error of a block."""
MOST_EFFECTS = 3
"""Most effects that one diagnosis names."""
OWN = (0.06, 0.3, 0.08)
"""What a further effect must explain beside those before it let loose (`form.beside_loose`): least
share of the first error above the floor, of what they leave, and least log gain."""
HALF = 0.5
"""Or it leaves at most this share of what those before it leave that are let loose."""
EXCHANGES = 4
"""Most rounds of exchanges."""


def name_effects(race: Race, first: list[Standing]) -> tuple[list[Standing], list[Standing]]:
    """(the effects that passed, in order, each on top of those before; the others beside them).

    Forward selection takes the single effect that explains most, which beside a second one may be
    the wrong one: after every step each named effect gives way to the one that does best beside the
    others (stepwise exchange: Miller 2002, "Subset selection in regression", sec. 3.5), and to
    nothing where the others explain its share.
    """
    named: list[Standing] = []
    following = first
    seen: dict[frozenset[str], list[Standing]] = {}
    while following and len(named) < MOST_EFFECTS:
        passed = next((s for s in following if _joins(race, first, named, s)), None)
        if passed is None:
            break
        named = _without_idle(race, first, _exchanged(race, [*named, passed]))
        names = frozenset(s.effect for s in named)
        # Exchanges may lead back to where they came from: of such a circle the best is taken.
        again = names in seen
        if again:
            circle = list(seen.values())[list(seen).index(names) :]
            named = min(circle, key=lambda some: float(race.losses(picked_by(some)).sum()))
        seen[names] = named
        following = race.standings(picked_by(named), tuple(s.effect for s in named))
        if again:
            break
    return named, following


def _joins(race: Race, first: list[Standing], named: list[Standing], s: Standing) -> bool:
    """Whether one effect on top of the named ones is beyond chance, large enough, and its own."""
    start = race.excess(race.losses())
    if not passes(race, first, named, s):
        return False
    if not named:
        return True
    left, own = beside_loose(race, named, s)
    least_share, least_gain, least_log = OWN
    share = (left - own.losses.sum()) / start
    large = share >= least_share and own.gain >= least_gain
    if large and own.p_value <= CHANCE and own.log_gain.mean() >= least_log:
        return True
    return bool(race.excess(s.losses) <= HALF * (left - race.floor.sum()))


def passes(race: Race, first: list[Standing], named: list[Standing], s: Standing) -> bool:
    """Whether one effect on top of the named ones is beyond chance and large enough."""
    start = race.excess(race.losses())
    share = (race.losses(picked_by(named)).sum() - s.losses.sum()) / start
    log_gain = s.log_gain.mean()
    if not named:
        if race.in_fit(s.effect):
            return False
        enough = LEAST_GAIN if race.whole_size >= 1.0 else SMALL
        if s.p_value <= CHANCE and share >= enough and log_gain >= LEAST_LOG_GAIN:
            return True
        chance, large, least = LARGE
        factor, most = FAR
        far = race.size(race.losses()) >= factor and share >= most
        return bool((far or s.p_value <= chance) and share >= large and log_gain >= least)
    if s.p_value > CHANCE or log_gain < LEAST_LOG_GAIN:
        return False
    least_gain, least_log, most = BESIDE
    alone = next((other.gain for other in first if other.effect == s.effect), 0.0)
    beside = s.gain >= least_gain and log_gain >= least_log and alone < most * named[0].gain
    no_shadow = s.gain >= NO_SHADOW[0] and log_gain >= NO_SHADOW[1]
    return bool(share >= NEXT_GAIN or beside or no_shadow or s.gain >= NEARLY_ALL)


def _exchanged(race: Race, named: list[Standing]) -> list[Standing]:
    """The named effects after exchanges, the one that would be missed most first."""
    for _ in range(EXCHANGES):
        changed = False
        for place in range(len(named)):
            others = named[:place] + named[place + 1 :]
            if not others:
                break
            best = race.standings(picked_by(others), tuple(s.effect for s in others))[0]
            changed = changed or best.effect != named[place].effect
            named = [*named[:place], best, *named[place + 1 :]]
        if not changed:
            break
    return _in_order(race, named)


def _in_order(race: Race, named: list[Standing]) -> list[Standing]:
    """The same effects, the one that would be missed most first, each on top of those before."""

    def missed(standing: Standing) -> float:
        rest = [other for other in named if other is not standing]
        return -float(race.losses(picked_by(rest)).sum())

    answer: list[Standing] = []
    for standing in sorted(named, key=missed):
        found = race.standings(picked_by(answer), tuple(s.effect for s in answer))
        again = next((s for s in found if s.effect == standing.effect), standing)
        answer.append(again)
    return answer


def _without_idle(race: Race, first: list[Standing], named: list[Standing]) -> list[Standing]:
    """The named effects without those whose share the others explain."""
    while len(named) > 1:
        for standing in reversed(named):
            others = [other for other in named if other is not standing]
            found = race.standings(picked_by(others), tuple(s.effect for s in others))
            again = next((s for s in found if s.effect == standing.effect), None)
            if again is None or not passes(race, first, others, again):
                named = _in_order(race, others)
                break
        else:
            break
    return named
