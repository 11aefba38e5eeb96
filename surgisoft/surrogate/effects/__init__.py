"""The physical effects by name: one file each, whose stem is the name of the effect."""

from collections.abc import Iterable
from pathlib import Path

from surgisoft.errors import InputError, unknown_name, wrong_type
from surgisoft.files import resolved
from surgisoft.surrogate.effects import user_defined
from surgisoft.surrogate.effects.base import (
    FRONT,
    STAGES,
    ArmFacts,
    Context,
    Effect,
    Memoryless,
    Quantity,
    Stage,
)
from surgisoft.surrogate.effects.check import check_effect
from surgisoft.surrogate.effects.contact import Contact
from surgisoft.surrogate.effects.coupling import Coupling
from surgisoft.surrogate.effects.creep import Creep
from surgisoft.surrogate.effects.dead_zone import DeadZone
from surgisoft.surrogate.effects.drift import Drift
from surgisoft.surrogate.effects.gain_mismatch import GainMismatch
from surgisoft.surrogate.effects.hypothesis import Hypothesis, hypothesis_of
from surgisoft.surrogate.effects.hysteresis import Hysteresis
from surgisoft.surrogate.effects.inertia import Inertia
from surgisoft.surrogate.effects.line_lag import LineLag
from surgisoft.surrogate.effects.misalignment import Misalignment
from surgisoft.surrogate.effects.payload import Payload
from surgisoft.surrogate.effects.rate_dependence import RateDependence
from surgisoft.surrogate.effects.readings import Reading, in_words
from surgisoft.surrogate.effects.softening import Softening
from surgisoft.surrogate.effects.stiffening import Stiffening
from surgisoft.surrogate.effects.twist import Twist
from surgisoft.surrogate.effects.zero_offset import ZeroOffset

EFFECTS: dict[str, type[Effect]] = {
    "line_lag": LineLag,
    "gain_mismatch": GainMismatch,
    "zero_offset": ZeroOffset,
    "coupling": Coupling,
    "dead_zone": DeadZone,
    "stiffening": Stiffening,
    "softening": Softening,
    "hysteresis": Hysteresis,
    "creep": Creep,
    "rate_dependence": RateDependence,
    "inertia": Inertia,
    "payload": Payload,
    "contact": Contact,
    "twist": Twist,
    "drift": Drift,
    "misalignment": Misalignment,
}
"""Every effect of the package by name; `known_effects` adds user-defined ones."""

__all__ = [
    "EFFECTS",
    "FRONT",
    "STAGES",
    "ArmFacts",
    "Context",
    "Effect",
    "Hypothesis",
    "Memoryless",
    "Quantity",
    "Reading",
    "Stage",
    "check_effect",
    "check_user_effects",
    "effect_class",
    "free_name",
    "hypothesis_of",
    "in_words",
    "known_effects",
    "make_effect",
    "named_effect",
    "named_effects",
    "register_effect_file",
    "register_effect_files",
    "registered_files",
]


def known_effects() -> dict[str, type[Effect]]:
    """Every known effect by name: the package's, installed packages', and those of named files."""
    known = dict(EFFECTS)
    for name in user_defined.offered():
        if name not in known and name not in user_defined.RESERVED:
            known[name] = user_defined.load_offered(name)
    return known | {name: file.kind for name, file in user_defined.FILES.items()}


def register_effect_file(path: str | Path) -> str:
    """Run a user's effect file and register its one `Effect`; returns its name, the file's stem.

    The file is code: register only files that the user has named.
    """
    return user_defined.register_effect_file(path, EFFECTS)


def register_effect_files(paths: Iterable[str | Path]) -> None:
    """Run several files of user-defined effects, as `register_effect_file` runs one.

    Raises InputError where two of them have one name, because only one could be used.
    """
    for path in _of_different_names(paths):
        register_effect_file(path)


def _of_different_names(paths: Iterable[str | Path]) -> list[Path]:
    """The files without repeats; raises InputError where two of them are effects of one name."""
    given: dict[str, Path] = {}
    for path in map(Path, paths):
        first = given.setdefault(path.stem, path)
        if resolved(first) != resolved(path):
            raise InputError(
                f"{path}: {first} is an effect '{path.stem}', too, expected files of different "
                "names; rename one of the two"
            )
    return list(given.values())


def registered_files() -> list[str]:
    """The files of user-defined effects that were registered: a new process has to do the same."""
    return [file.path for file in user_defined.FILES.values()]


def named_effects(given: Iterable[str | Path]) -> list[str]:
    """The names of effects, each given as to `named_effect`; files have to have different names.

    Raises InputError for other types.
    """
    expected = "the name of an effect, its file (my_effect.py), or several of them"
    if not isinstance(given, Iterable):
        raise wrong_type("effects", given, expected)
    given = list(given)
    for each in given:
        if not isinstance(each, str | Path):
            raise wrong_type("one of the effects", each, expected)
    names = [str(each) for each in given]
    _of_different_names(each for each in names if _is_file(each))
    return [named_effect(each) for each in names]


def _is_file(given: str) -> bool:
    return given.endswith(".py") or "/" in given


def named_effect(given: str) -> str:
    """The name of an effect given by name or by path (`path/to/my_effect.py`, which is run)."""
    if _is_file(given):
        return register_effect_file(given)
    known = known_effects()
    if given not in known:
        raise unknown_name("effect", given, known)
    return given


def effect_class(name: str) -> type[Effect]:
    """The class of an effect by its name in a model: `creep`, or `creep#2` for a second creep."""
    kind = user_defined.kind_of(name)
    if kind in EFFECTS:
        return EFFECTS[kind]
    known = known_effects()
    if kind not in known:
        raise unknown_name("effect", kind, known)
    return known[kind]


def make_effect(name: str, facts: ArmFacts, **config) -> Effect:
    """The named effect for an arm; `config` are the arguments of its class."""
    return effect_class(name)(facts, **config)


def check_user_effects(
    facts: ArmFacts, names: Iterable[str] | None = None, tried: bool = False
) -> None:
    """Try the user-defined effects among some on an arm; whatever fails is an InputError.

    names: of effects; None: those of all files that were named. tried: as identification tries
    them.
    """
    for name in list(user_defined.FILES) if names is None else names:
        if name in EFFECTS:
            continue
        file = user_defined.FILES.get(name)
        label = f"effect '{name}'" if file is None else file.path
        check_effect(effect_class(name), facts, label, "" if file is None else file.path, tried)


def free_name(kind: str, taken: Iterable[str]) -> str:
    """Name of one more effect of a kind in a model that has the effects `taken`: `creep#2`."""
    number, name = 1, kind
    while name in taken:
        number += 1
        name = f"{kind}#{number}"
    return name
