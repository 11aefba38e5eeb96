"""Check of a user-defined effect on an arm, before anything is computed with it.

An effect is code of the user. What it does wrong is told in one line at once, and not after the
training or the fits that precede its use.
"""

import copy
import json

import torch
from torch import Tensor

from surgisoft.errors import InputError, raised_by
from surgisoft.surrogate.effects.base import FRONT, ArmFacts, Context, Effect, Quantity
from surgisoft.surrogate.effects.hypothesis import hypothesis_of

ROWS = 5
"""Rows of the run on which an effect is tried, over the whole range of the actuation (a count)."""
STEP_S = 0.1
"""Time between these rows, s."""
BEND_MM = 5.0
"""Displacement of the tip in these rows, mm."""
TRIED_AMPLITUDE = 0.1
"""Amplitude with which the change of the signal is compared with its derivative, in its unit."""
UNCHANGED = 1e-5
"""Largest change of the signal at zero amplitude, as a share of its largest value."""


def check_effect(
    kind: type[Effect], facts: ArmFacts, label: str, file: str = "", tried: bool = False
) -> None:
    """Raise InputError, one line, where an effect does not keep the promises of `Effect`.

    It is built for the arm and from its own `config`, steps and scans a few rows, and gives its
    amplitudes, sensitivities and quantities. label: what messages call it; file: its file, whose
    line messages state; tried: as identification builds it (`Hypothesis.candidates`).
    """
    with torch.random.fork_rng(devices=[]):
        try:
            made = _candidates(kind, facts) if tried else [kind(facts)]
            for effect in made:
                _check_one(effect, facts, label)
        except InputError:
            raise
        except (Exception, SystemExit) as error:
            raise raised_by(label, error, "effect", file) from error


def _candidates(kind: type[Effect], facts: ArmFacts) -> list[Effect]:
    return list(hypothesis_of(kind).candidates(facts, _body(facts)))


def _body(facts: ArmFacts) -> Tensor:
    """(ROWS, n, 3) key points in mm that bend from one side to the other, base frame."""
    share = torch.linspace(0.0, 1.0, len(facts.rest_mm))[:, None].square()
    aside = torch.linspace(-BEND_MM, BEND_MM, ROWS)[:, None, None]
    return facts.rest_mm + aside * share * torch.tensor([1.0, 0.5, 0.0])


def _changes(effect: Effect, amplitude: Tensor, signal: Tensor, memory: Tensor) -> bool:
    """Whether a signal after an effect changes with one of its amplitudes, which is zero here."""
    before = effect.apply(signal, memory)
    amplitude.fill_(TRIED_AMPLITUDE)
    after = effect.apply(signal, memory)
    amplitude.zero_()
    return float((after - before).abs().max()) > UNCHANGED * float(signal.abs().max())


def _check_one(effect: Effect, facts: ArmFacts, label: str) -> None:
    def wrong(what: str, expected: str) -> InputError:
        return InputError(f"{label}: {what}, expected {expected}; correct the effect")

    def check(part: str, value: object, shape: tuple[int, ...]) -> None:
        """A result of a method has to be a finite tensor of a shape."""
        if not isinstance(value, Tensor) or tuple(value.shape) != shape:
            came = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            raise wrong(f"'{part}' returned {came}", f"a tensor {shape}")
        if not value.isfinite().all():
            raise wrong(f"'{part}' returned values that are not finite", "finite ones")

    share = torch.linspace(0.0, 1.0, ROWS)[:, None]
    pressure = (facts.low + (facts.high - facts.low) * share)[None]
    signal = pressure if effect.stage in FRONT else _body(facts)[None]
    dt_s = torch.full((1, ROWS), STEP_S)
    dt_s[:, 0] = 0.0
    context = Context(dt_s, dt_s.cumsum(1), None, pressure)
    amplitudes = effect.amplitudes()
    if not isinstance(amplitudes, dict) or not amplitudes:
        raise wrong(f"'amplitudes' returned {amplitudes!r}", "at least one parameter by its name")
    effect.nonlinear_parameters()
    effect.memory_parameters()
    zero = copy.deepcopy(effect)
    with torch.no_grad():
        for value in zero.amplitudes().values():
            value.zero_()
        rest = zero.rest(signal[:, 0])
        if not isinstance(rest, Tensor) or len(rest) != 1:
            raise wrong("'rest' returned no memory of one arm", "a tensor (B, ...)")
        along = zero.scan(rest, signal, context)
        check("scan", along, (1, ROWS, *rest.shape[1:]))
        after = zero.apply(signal, along)
        check("apply", after, tuple(signal.shape))
        if float((after - signal).abs().max()) > UNCHANGED * float(signal.abs().max()):
            raise wrong(
                "it changes the signal at zero amplitude", "none of the signal to change then"
            )
        now = Context(dt_s[:, 1], context.t_s[:, 1], None, pressure[:, 1])  # type: ignore[index]
        memory, stepped = zero.step(rest, signal[:, 1], now)
        check("advance", memory, tuple(rest.shape))
        check("apply", stepped, tuple(signal[:, 1].shape))
        count = sum(value.numel() for value in amplitudes.values())
        slopes = zero.sensitivities(signal, along)
        check("sensitivities", slopes, (count, *signal.shape))
        begin = 0
        for name, value in zero.amplitudes().items():
            of_name = slopes[begin : begin + value.numel()]
            begin += value.numel()
            if not of_name.any() and _changes(zero, value, signal, along):
                raise wrong(
                    f"the derivative of its result by the amplitude '{name}' is zero at zero, "
                    "though the result changes with it",
                    "a result that is linear in it near zero: no square, 'abs' or 'relu' of it, "
                    "and no 'detach'",
                )
    quantities = effect.quantities()
    if not all(isinstance(each, Quantity) for each in quantities):
        raise wrong("'quantities' returned something else", "a list of Quantity")
    effect.implausible()
    effect.readings()
    again = type(effect)(facts, **json.loads(json.dumps(effect.config())))
    shapes, others = (
        {name: value.shape for name, value in each.state_dict().items()} for each in (effect, again)
    )
    if shapes != others:
        raise wrong("'config' builds an effect of other parameters", "the arguments of this one")
