"""Rigs by name: `NAME[:option=value,...]`, with options that are typed and checked.

A rig is opened by a callable whose keyword parameters are its options: a class, a dataclass or a
function, with an annotation of `str`, `int`, `float`, `bool`, `Path`, or a tuple of one of them,
for each parameter. The package's rigs are in `RIGS`. Another package offers one in the entry point
group `surgisoft.rigs`; any other callable is named as `package.module:object` or
`FILE.py:object`.
"""

import functools
import importlib
import importlib.util
import inspect
import math
import os
import re
import sys
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin, get_type_hints

from surgisoft.errors import InputError, raised_at, raised_by, unknown_name
from surgisoft.files import resolved
from surgisoft.python_files import run_file
from surgisoft.rig.drivers.serial_rig import SerialRig
from surgisoft.rig.hidden import HIDDEN
from surgisoft.rig.interface import Rig, is_simulated
from surgisoft.rig.motion_capture import CameraDesign
from surgisoft.rig.safety import SafeRig, Safety
from surgisoft.rig.virtual import MOUNT, VirtualRig

GROUP = "surgisoft.rigs"
"""Entry point group of rigs in other packages."""
LIST_SEPARATOR = "/"
"""Separates the items of an option with several values: `gravity=0/0/1`."""

Gravity = Annotated[
    tuple[float, float, float], "direction of weight, arm base frame before the roll"
]
HiddenEffects = Annotated[
    tuple[str, ...], "hidden effects, NAME or NAME:AMPLITUDE; @SECONDS behind it: begins later"
]
LastingEffects = Annotated[
    tuple[str, ...], "hidden effects, NAME or NAME:AMPLITUDE, from the start"
]
RobotSeed = Annotated[int, "seed of the robot"]
NoiseSeed = Annotated[int, "seed of the noise of sensors and cameras"]
RollDeg = Annotated[float, "rotation of the base about its axis [deg]"]
PayloadG = Annotated[float, "known mass at the tip [g]"]
NoiseFactor = Annotated[float, "factor on all noise of sensors and cameras"]


def virtual(
    seed: RobotSeed = 0,
    noise_seed: NoiseSeed = 0,
    hidden: HiddenEffects = (),
    gravity: Gravity = MOUNT,
    roll_deg: RollDeg = 0.0,
    payload_g: PayloadG = 0.0,
    noise: NoiseFactor = 1.0,
    rate_Hz: Annotated[float, "samples per second"] = CameraDesign().rate_Hz,
) -> Rig:
    """The project's own simulated bench: a quasi-static rod, syringe pumps, motion capture."""
    return VirtualRig(
        seed,
        take=noise_seed,
        hidden=tuple(hidden_effects(hidden)),
        gravity=gravity,
        roll_deg=roll_deg,
        payload_g=payload_g,
        noise=noise,
        cameras=CameraDesign(rate_Hz=rate_Hz),
    )


def elastica(
    seed: RobotSeed = 0,
    noise_seed: NoiseSeed = 0,
    hidden: LastingEffects = (),
    gravity: Gravity | None = None,
    roll_deg: RollDeg = 0.0,
    payload_g: PayloadG = 0.0,
    noise: NoiseFactor = 1.0,
    elements: Annotated[int, "elements of the rod"] = 12,
) -> Rig:
    """A simulated bench with PyElastica's Cosserat rod: other robots, other physics."""
    return _elastica().ElasticaRig(
        seed,
        take=noise_seed,
        hidden=_from_the_start(hidden),
        gravity=gravity,
        roll_deg=roll_deg,
        payload_g=payload_g,
        noise=noise,
        elements=elements,
    )


RIGS: dict[str, Callable[..., Rig]] = {
    "virtual": virtual,
    "elastica": elastica,
    "serial": SerialRig,
}
"""The rigs of this package by name."""
SIMULATED = ("virtual", "elastica")
"""Names of the simulated rigs, which have hidden effects."""


def hidden_of(name: str) -> dict[str, Any]:
    """The hidden effects of the simulated rig of a name; each has a `place` and `about`."""
    name = parse_rig(name).name
    if name == "virtual":
        return HIDDEN
    if name == "elastica":
        return _elastica().HIDDEN
    if name not in rig_names():
        raise unknown_name("rig", name, rig_names())
    raise InputError(f"rig '{name}' has no hidden effects; {' and '.join(SIMULATED)} have")


def _elastica() -> ModuleType:
    """The package of the PyElastica rig; raises InputError where PyElastica is not installed."""
    if importlib.util.find_spec("elastica") is None:
        raise InputError(
            "the rig 'elastica' needs PyElastica, which is not installed: "
            "pip install 'surgisoft[elastica]'"
        )
    return importlib.import_module("surgisoft.rig.elastica")


HiddenEffect = tuple[str, float] | tuple[str, float, float]
"""Name and amplitude of a hidden effect and, where it is not there from the start, the time after
the first reset at which it begins [s]."""


def hidden_effects(given: Iterable[str | HiddenEffect] | None) -> list[HiddenEffect]:
    """Hidden effects from text such as `creep`, `creep:0.5` or `payload:1@360`; amplitude 1.

    `@360` lets the effect begin 360 s after the first reset. Raises InputError for an amplitude or
    a time that is no number.
    """
    found: list[HiddenEffect] = []
    for item in given or ():
        if not isinstance(item, str):
            size, *late = (float(value) for value in item[1:])
            found.append((item[0], size, late[0]) if late else (item[0], size))
            continue
        effect, at, begins_s = item.partition("@")
        name, colon, amplitude = effect.partition(":")
        try:
            size = float(amplitude) if colon else 1.0
            found.append((name, size, float(begins_s)) if at else (name, size))
        except ValueError:
            raise InputError(
                f"hidden effect '{item}': expected NAME or NAME:AMPLITUDE, either with @SECONDS"
            ) from None
    return found


def _from_the_start(given: Iterable[str | HiddenEffect]) -> tuple[HiddenEffect, ...]:
    """Hidden effects of a rig that cannot let one begin later."""
    found = tuple(hidden_effects(given))
    late = [effect[0] for effect in found if len(effect) == 3]
    if late:
        raise InputError(
            f"hidden effect '{late[0]}' with a time (@SECONDS): the rig 'elastica' has all its "
            "effects from the start; use the rig 'virtual'"
        )
    return found


@dataclass(frozen=True)
class RigText:
    """Rig and options of a text `NAME[:option=value,...]`."""

    name: str
    """Name of a rig, `package.module:object` or `FILE.py:object`."""
    options: Mapping[str, str]
    """Option -> value as it was written."""


@dataclass(frozen=True)
class RigOption:
    """One option of a rig."""

    name: str
    """Name of the parameter."""
    kind: Any
    """Type of its value: str, int, float, bool, Path, or a tuple of one of them."""
    default: Any
    """Value without the option; `REQUIRED` where there is none."""
    about: str
    """What the option means; empty where its author does not say."""

    @property
    def shown(self) -> str:
        """The default as it is written in a rig's text."""
        if isinstance(self.default, tuple):
            items = (f"{x:.4g}" if isinstance(x, float) else str(x) for x in self.default)
            return LIST_SEPARATOR.join(items) or "none"
        return "none" if self.default in (None, "") else str(self.default)


REQUIRED: Any = inspect.Parameter.empty
"""Default of an option that must be given."""


def rig_names() -> list[str]:
    """Names of the package's rigs and of those that other packages offer."""
    return [*RIGS, *(name for name in _offered() if name not in RIGS)]


def parse_rig(text: str) -> RigText:
    """Name and options of `NAME[:option=value,...]`, `package.module:object[:...]` or
    `FILE.py:object[:...]`."""
    name, colon, rest = text.strip().partition(":")
    if rest and "=" not in rest.partition(":")[0] and name not in rig_names():
        attribute, more, rest = rest.partition(":")
        name, colon = f"{name}:{attribute}", more
    options: dict[str, str] = {}
    for part in rest.split(",") if colon else ():
        option, equals, value = part.partition("=")
        option = option.strip()
        if not equals or not option.isidentifier():
            raise InputError(f"rig '{text}': got '{part}', expected option=value after '{name}:'")
        if option in options:
            raise InputError(f"rig '{text}': option '{option}' is given twice")
        options[option] = value.strip()
    if not re.fullmatch(r"[\w.-]+(:[\w.]+)?|.+\.py:[\w.]+", name):
        raise InputError(
            f"rig '{text}': expected NAME[:option=value,...], package.module:object or "
            f"FILE.py:object; known names are {', '.join(rig_names())}"
        )
    return RigText(name, options)


def rig_factory(name: str) -> Callable[..., Rig]:
    """The callable that opens the rig of a name; its keyword parameters are the options."""
    if name in RIGS:
        return RIGS[name]
    if ":" in name:
        return _checked_factory(name, _object(name))
    offered = _offered()
    if name.endswith(".py"):
        raise InputError(f"rig '{name}': expected FILE.py:object, such as {name}:Bench")
    if name not in offered:
        raise unknown_name("rig", name, rig_names())
    entry = offered[name]
    try:
        found = entry.load()
    except Exception as error:
        raise InputError(
            f"rig '{name}' ({entry.value}): does not load ({raised_at(error)}); correct or "
            "remove that package"
        ) from error
    return _checked_factory(name, found)


def rig_options(name: str) -> dict[str, RigOption]:
    """The options of the rig of a name, in the order of its parameters."""
    return _options(name, rig_factory(name))


def rig_about(name: str) -> str:
    """The first sentence of the documentation of the rig of a name."""
    text = inspect.getdoc(rig_factory(name)) or ""
    return " ".join(text.partition("\n\n")[0].split())


class _Asked(NamedTuple):
    """What a text asks for, checked."""

    name: str
    """Name of the rig."""
    factory: Callable[..., Rig]
    """What makes it."""
    own: dict[str, RigOption]
    """Options of the rig itself."""
    known: dict[str, RigOption]
    """Those, and the safety limits of a real rig."""
    values: dict[str, Any]
    """Options that the text gives, with their types."""


def _asked(text: str, beside: Iterable[str] = ()) -> _Asked:
    """The rig and the options of a text; beside: names of options that are given apart from it."""
    asked = parse_rig(text)
    factory = rig_factory(asked.name)
    own = _options(asked.name, factory)
    limits = safety_options() if may_be_real(asked.name) else {}
    known = own | {name: option for name, option in limits.items() if name not in own}
    unknown = [name for name in (*asked.options, *beside) if name not in known]
    if unknown:
        has = ", ".join(known) or "none"
        raise InputError(f"rig '{asked.name}': unknown option '{unknown[0]}'; its options: {has}")
    values = {
        option: _value(asked.name, known[option], written)
        for option, written in asked.options.items()
    }
    return _Asked(asked.name, factory, own, known, values)


def may_be_real(text: str) -> bool:
    """Whether the rig of a text may be a real one, as far as that is known before it opens.

    The package's simulated rigs and classes with the method of a simulated rig
    (`surgisoft.rig.interface.SimulatedRig`) are none; what a function opens may be one. Raises
    InputError for a text that names no rig.
    """
    name = parse_rig(text).name
    return name not in SIMULATED and not hasattr(rig_factory(name), "read_beside_truth")


def given_options(text: str) -> dict[str, Any]:
    """The options that a rig's text gives, with their types; raises InputError as `check_rig`."""
    return _asked(text).values


def check_rig(text: str) -> None:
    """Raise InputError for a text that names no rig, or options that it does not have.

    Opens nothing, so that a command can refuse before it writes or waits.
    """
    _asked(text)


def known_size(text: str, defaults: Mapping[str, Any] | None = None) -> tuple[int, int] | None:
    """Numbers of chambers and key points of the rig of a text where they are known before it opens.

    Of the rig `elastica`, whose first opening compiles for many seconds. None: not known. defaults:
    see `open_rig`. Raises InputError as `check_rig` does.
    """
    asked = _asked(text)
    seed = asked.values.get("seed", (defaults or {}).get("seed", 0))
    return _elastica().robot_size(seed) if asked.name == "elastica" and seed >= 0 else None


def open_rig(text: str, defaults: Mapping[str, Any] | None = None, **fields: Any) -> Rig:
    """Open the rig that `NAME[:option=value,...]` or `package.module:object[:...]` names, or
    `FILE.py:object[:...]`.

    A real rig comes inside `SafeRig`, whose limits (`Safety`) are options of every real rig. Use it
    in a block `with guarded(rig)` (`surgisoft.rig.safety`), which vents it at the end.
    fields: options that are given apart from the text, such as `payload_g=2.0`. defaults: options
    that count where the rig has them and nothing else gives them. Raises InputError for an unknown
    option, a value of another type, what the rig itself refuses, and an exception in it.
    """
    asked = _asked(text, fields)
    own, known, values = asked.own, asked.known, asked.values
    for option, value in fields.items():
        if option in values and values[option] != value:
            raise InputError(
                f"rig '{asked.name}': option '{option}' is {values[option]!r} in the rig's text "
                f"and {value!r} beside it; give it once"
            )
        values[option] = value
    for option, value in (defaults or {}).items():
        if option in known:
            values.setdefault(option, value)
    missing = [o.name for o in known.values() if o.default is REQUIRED and o.name not in values]
    if missing:
        raise InputError(
            f"rig '{asked.name}': option '{missing[0]}' is missing; "
            f"expected {asked.name}:{','.join(f'{name}=...' for name in missing)}"
        )
    limits = {option: values.pop(option) for option in list(values) if option not in own}
    rig = _made(asked, values)
    if not is_simulated(rig):
        return SafeRig(rig, _safety(asked.name, limits))
    if limits:
        raise InputError(
            f"rig '{asked.name}': option '{next(iter(limits))}' is a safety limit of real rigs, "
            "and this one is simulated"
        )
    return rig


def _made(asked: _Asked, values: dict[str, Any]) -> Any:
    """The rig that is asked for; raises InputError for an exception in a rig of the user."""
    try:
        return asked.factory(**values)
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        if asked.name in RIGS:
            raise
        raise raised_by(f"rig '{asked.name}'", error, "rig or its options") from error


def _safety(name: str, limits: dict[str, Any]) -> Safety:
    try:
        return Safety(**limits)
    except InputError as error:
        raise InputError(f"rig '{name}': {error}") from None


def safety_options() -> dict[str, RigOption]:
    """The options of the safety wrapper, which every real rig has beside its own."""
    return _options("safety", Safety)


def _offered() -> dict[str, EntryPoint]:
    """Entry points of rigs in installed packages by name; none is loaded."""
    return _entries(tuple(sys.path))


@functools.cache
def _entries(path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Those while the search path is this one: reading them takes 5 ms."""
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def _object(name: str) -> Any:
    """The object `package.module:object`, where modules of the working folder count, too, or
    `FILE.py:object`."""
    module_name, _, path = name.rpartition(":")
    in_file = module_name.endswith(".py")
    if in_file and not Path(module_name).is_file():
        raise InputError(f"rig '{name}': no file {module_name}; expected FILE.py:object")
    here = os.getcwd()
    if here not in sys.path and "" not in sys.path:
        sys.path.append(here)
    try:
        found: Any = _of_file(module_name) if in_file else importlib.import_module(module_name)
    except (Exception, SystemExit) as error:
        raise InputError(
            f"rig '{name}': {'file' if in_file else 'module'} '{module_name}' does not load "
            f"({raised_at(error)}); expected package.module:object or FILE.py:object"
        ) from error
    for part in path.split("."):
        if not hasattr(found, part):
            raise InputError(f"rig '{name}': '{module_name}' has no '{path}'; correct the name")
        found = getattr(found, part)
    return found


FILES: dict[Path, tuple[bytes, ModuleType]] = {}
"""Content and module of each Python file that was named as a rig."""


def _of_file(name: str) -> ModuleType:
    """The module of a Python file, which is run once and again where its content has changed."""
    path = Path(name)
    place, content = resolved(path), path.read_bytes()
    known = FILES.get(place)
    if known is None or known[0] != content:
        FILES[place] = content, run_file(path, content, "surgisoft_rig")
    return FILES[place][1]


def _checked_factory(name: str, found: Any) -> Callable[..., Rig]:
    if not callable(found):
        raise InputError(
            f"rig '{name}': is a {type(found).__name__}; expected a class or a function that "
            "opens the rig"
        )
    return found


def _options(name: str, factory: Callable[..., Any]) -> dict[str, RigOption]:
    target = factory.__init__ if inspect.isclass(factory) else factory
    try:
        hints = get_type_hints(target, include_extras=True)
    except Exception:  # names that exist for a type checker only
        hints = {}
    found = {}
    for parameter in inspect.signature(factory).parameters.values():
        if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            continue
        if parameter.kind is parameter.POSITIONAL_ONLY:
            raise InputError(
                f"rig '{name}': parameter '{parameter.name}' has no name for a caller; expected "
                "keyword parameters, which are the rig's options"
            )
        kind, about = _plain(hints.get(parameter.name, _of_default(parameter.default)))
        found[parameter.name] = RigOption(parameter.name, kind, parameter.default, about)
    return found


def _of_default(default: Any) -> Any:
    """Type of an option without an annotation."""
    return str if default is REQUIRED or default is None else type(default)


def _plain(hint: Any) -> tuple[Any, str]:
    """The type of an annotation without `Annotated` and `None`, and the text beside it."""
    about = ""
    while True:
        if get_origin(hint) is Annotated:
            about = next((x for x in hint.__metadata__ if isinstance(x, str)), about)
            hint = hint.__origin__
        elif get_origin(hint) in (Union, types.UnionType):
            rest = [part for part in get_args(hint) if part is not type(None)]
            if len(rest) != 1:
                return hint, about
            hint = rest[0]
        else:
            return hint, about


KINDS = {
    str: "text",
    int: "a whole number",
    float: "a finite number",
    bool: "true or false",
    Path: "a path",
}
"""Types of an option's value -> their names in messages."""
WORDS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
"""Values of an option that is true or false."""


def describe_kind(kind: Any) -> str:
    """Name of the type of an option's value for people."""
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        if len(parts) == 2 and parts[1] is Ellipsis:
            return f"{_several(parts[0])} separated by '{LIST_SEPARATOR}'"
        return f"{len(parts)} of {_several(parts[0])} separated by '{LIST_SEPARATOR}'"
    return KINDS.get(kind, getattr(kind, "__name__", str(kind)))


def _several(kind: Any) -> str:
    return {str: "texts", int: "whole numbers", float: "numbers"}.get(kind, "values")


def _value(rig: str, option: RigOption, written: str) -> Any:
    """The value of an option from its text."""
    kind = option.kind
    try:
        if get_origin(kind) is tuple:
            parts = get_args(kind)
            items = written.split(LIST_SEPARATOR) if written else []
            if not (len(parts) == 2 and parts[1] is Ellipsis) and len(items) != len(parts):
                raise ValueError
            return tuple(_scalar(parts[0], item) for item in items)
        return _scalar(kind, written)
    except ValueError:
        raise InputError(
            f"rig '{rig}': option '{option.name}' is '{written}', expected {describe_kind(kind)}"
        ) from None


def _scalar(kind: Any, written: str) -> Any:
    if kind is bool:
        if written.lower() not in WORDS:
            raise ValueError
        return WORDS[written.lower()]
    if kind is float:
        value = float(written)
        if not math.isfinite(value):
            raise ValueError
        return value
    return kind(written) if kind in (int, Path) else written
