"""Laws of the injected effects: key points of a rod with an effect, along the same loads.

An effect acts on the loads of the chambers (line), on the free strains of the sections (material),
as a force on the rod (body) or on the key points (frame, markers). Loads are 0 at rest; the largest
range of a chamber is 1. Strains are taken relative to the largest bending and stretch of a section
along the loads. The laws and what they differ in from the effects of the arm model:

| effect | law here | in the arm model |
|---|---|---|
| `line_lag`, pneumatic | orifice flow of ISO 6358 (elliptic below the critical ratio) | tube, flow with the root of the difference |
| `line_lag`, servo | servo that saturates in its speed, v tanh(k d / v) | the same effect |
| `dead_zone` | slack as a softplus | smoothed by a root |
| `gain_mismatch` | one chamber's gain: the only form there is | coincides |
| `zero_offset` | one chamber's zero, down to its lowest load | constant |
| `hysteresis` | Bouc-Wen, biaxial (Park, Wen & Ang 1986), of the section's bending | play operators on the chambers |
| `creep` | power law of time as a fractional kernel (Scott Blair 1947) | sums of retarded elements |
| `rate_dependence` | Zener solid with Eyring's (1936) sinh dashpot | Kelvin-Voigt, Ellis fluid |
| `stiffening` | limited chains (Gent 1996, in bending) | exponential (Fung) |
| `softening` | exp(-b sqrt(M - m)) (Beatty & Krishnaswamy 2000) | energy, exponential (Ogden & Roxburgh) or inverse root |
| `payload` | weight at the tip, equilibrium of the deformed rod; a weight coincides | beam, displacement to first order |
| `contact` | unilateral spring between key points, in equilibrium | displacement of the beam to first order |
| `twist` | torsion by the mean square of the loads | by the mean load |
| `misalignment` | rotation and shift of the frame: coincides | rotation, shift, scale |
| `drift` | rotation of the base with the logarithm of time | saturating exponential |

A chamber's dead time, inertia and coupling are not injected. Unknown effects have no law in the arm
model at all.
"""  # noqa: E501

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import fftconvolve

from benchmarks.injected.rod import PIECES, Rod, Support, Weight, balanced, key_points, turned

STEPS = 4
"""Steps of an integration between two rows."""
ATMOSPHERE = {"psi": 14.7, "kPa": 101.3, "bar": 1.013}
"""Atmospheric pressure in the units of pneumatic actuation."""
CRITICAL_RATIO = 0.3
"""Critical pressure ratio b of a tube with fittings (ISO 6358; 0.2 to 0.5)."""
KERNEL_S = 0.05
"""Step of the grid on which creep is convolved, s."""
MOVES_SHARE = 0.4
"""A chamber counts as moved where it bends the arm by this share of the one that bends it most."""
SUPPORT_SHARE = 3.0
"""Stiffness of a support times the compliance of the straight rod: it holds back three quarters."""

Drawn = dict[str, float | int | list[float]]
"""Constants of an effect that are drawn for a case."""


@dataclass(frozen=True, eq=False)
class Arm:
    """A rod along one recording, thinned: T rows, m chambers, n key points."""

    rod: Rod
    """The rod."""
    t_s: np.ndarray
    """(T,) time since the start of the recording, s; goes on through all runs."""
    starts: np.ndarray
    """(R + 1,) first row of each run, and T."""
    loads: np.ndarray
    """(T, m) loads of the chambers."""
    unit: str
    """Unit of the actuation."""
    span: float
    """Actuation at load 1 less that at rest, in the unit."""
    gravity: np.ndarray
    """(3,) direction of the weight, arm base frame."""

    def points(
        self,
        loads: np.ndarray | None = None,
        strains: np.ndarray | None = None,
        force: Weight | Support | None = None,
    ) -> np.ndarray:
        """(T, n, 3) key points under other loads or strains, or a force, mm."""
        if strains is None:
            strains = self.rod.strains(self.loads if loads is None else loads)
        return key_points(self.rod, balanced(self.rod, strains, force))

    def relative(self) -> tuple[np.ndarray, np.ndarray]:
        """(T, S, 3) bending x, y and stretch beyond rest, as shares of their largest; (1, S, 3)."""
        free = self.rod.strains(self.loads)[..., [0, 1, 3]]
        free = free - self.rod.strains(np.zeros_like(self.loads[:1]))[..., [0, 1, 3]]
        bend = np.linalg.norm(free[..., :2], axis=2).max(0)
        stretch = np.abs(free[..., 2]).max(0)
        most = np.stack([bend, bend, stretch], axis=1)[None]
        most = np.where(most > 0, most, 1.0)
        return free / most, most

    def with_relative(self, relative: np.ndarray, most: np.ndarray) -> np.ndarray:
        """(T, n, 3) key points under relative strains (T, S, 3), mm."""
        strains = np.repeat(self.rod.strains(np.zeros_like(self.loads[:1])), len(relative), axis=0)
        strains[..., [0, 1, 3]] += relative * most
        return self.points(strains=strains)

    def along_runs(self, law: Callable[[np.ndarray, slice], np.ndarray], signal: np.ndarray):
        """A law with memory applied to each run of a signal (T, ...) by itself."""
        parts = [
            law(signal[begin:end], slice(begin, end))
            for begin, end in zip(self.starts[:-1], self.starts[1:], strict=True)
        ]
        return np.concatenate(parts)


Draw = Callable[[Arm, np.random.Generator], Drawn]
Moved = Callable[[Arm, Drawn, float], np.ndarray]


@dataclass(frozen=True)
class Law:
    """One effect."""

    truth: str
    """Name of the effect in the arm model's catalogue, or `unknown`."""
    draw: Draw
    """Draws the constants of a case."""
    points: Moved
    """(T, n, 3) key points of the rod with the effect of a strength > 0, mm."""
    most: float
    """Largest strength that is still plausible."""


def points_of(law: Law, arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """(T, n, 3) key points of the rod with an effect, mm; strength 0: without it."""
    return arm.points() if strength == 0 else law.points(arm, drawn, strength)


def nothing_drawn(arm: Arm, rng: np.random.Generator) -> Drawn:
    """No constants."""
    return {}


# Line ------------------------------------------------------------------------------------------


def _lag(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    rate = _servo if arm.unit not in ATMOSPHERE else _orifice
    return arm.points(loads=arm.along_runs(lambda x, rows: rate(arm, x, rows, strength), arm.loads))


def _orifice(arm: Arm, loads: np.ndarray, rows: slice, strength: float) -> np.ndarray:
    """Loads (T, m) behind an orifice: p' = C p_up psi(p_down / p_up), ISO 6358.

    strength: seconds in which choked flow from two atmospheres would fill one atmosphere.
    """
    air = ATMOSPHERE[arm.unit]
    pressure = (loads * arm.span + air) / air
    found = np.empty_like(pressure)
    now = pressure[0].copy()
    steps = np.diff(arm.t_s[rows], prepend=arm.t_s[rows.start]) / STEPS
    for row, (wanted, step) in enumerate(zip(pressure, steps, strict=True)):
        for _ in range(STEPS):
            high, low = np.maximum(wanted, now), np.minimum(wanted, now)
            over = np.maximum(low / high - CRITICAL_RATIO, 0.0) / (1 - CRITICAL_RATIO)
            change = step / strength * high / 2 * np.sqrt(np.maximum(1 - over**2, 0.0))
            now = now + np.clip(wanted - now, -change, change)
        found[row] = now
    return (found * air - air) / arm.span


def _servo(arm: Arm, loads: np.ndarray, rows: slice, strength: float) -> np.ndarray:
    """Loads (T, m) behind servos of limited speed: x' = v tanh((command - x) / (v tau)).

    strength: tau in s; the speed v is 0.5 / tau, so that half the range is a large difference.
    """
    found = np.empty_like(loads)
    now = loads[0].copy()
    speed = 0.5 / strength
    steps = np.diff(arm.t_s[rows], prepend=arm.t_s[rows.start]) / STEPS
    for row, (wanted, step) in enumerate(zip(loads, steps, strict=True)):
        for _ in range(STEPS):
            gap = wanted - now
            change = step * speed * np.tanh(np.abs(gap) / (speed * strength))
            now = now + np.clip(gap, -change, change)
        found[row] = now
    return found


def _dead_zone(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """sign(x) w (log(1 + exp((|x| - d) / w)) - log(1 + exp(-d / w))), w = d / 4."""
    width = strength / 4
    size = np.logaddexp(0, (np.abs(arm.loads) - strength) / width)
    return arm.points(
        loads=np.sign(arm.loads) * width * (size - np.logaddexp(0, -strength / width))
    )


def _draw_chamber(arm: Arm, rng: np.random.Generator) -> Drawn:
    moved = arm.loads.std(0) * np.linalg.norm(arm.rod.bend, axis=1).sum(0)
    chambers = np.flatnonzero(moved > MOVES_SHARE * moved.max())
    return {"chamber": int(rng.choice(chambers)), "sign": float(rng.choice([-1.0, 1.0]))}


def _gain(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    gains = np.ones(arm.loads.shape[1])
    gains[drawn["chamber"]] += drawn["sign"] * strength
    return arm.points(loads=arm.loads * gains)


def _zero(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """A regulator or motor whose sensor reads a constant too much or too little."""
    shift = np.zeros(arm.loads.shape[1])
    shift[drawn["chamber"]] = drawn["sign"] * strength
    return arm.points(loads=np.maximum(arm.loads + shift, arm.loads.min(0)))


# Material --------------------------------------------------------------------------------------


def _draw_hysteresis(arm: Arm, rng: np.random.Generator) -> Drawn:
    return {"yield": float(rng.uniform(0.1, 0.3)), "beta": float(rng.uniform(0.4, 0.7))}


def _hysteresis(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """Strain less the friction z: z' = u' - z (beta |u' z| + (1 - beta) u' z), u in yields.

    Park, Wen & Ang (1986, eq. 3) with n = 2: bending is a vector, stretch a scalar.
    """
    gap, beta = drawn["yield"], drawn["beta"]

    def friction(strain: np.ndarray, rows: slice) -> np.ndarray:
        found = np.zeros_like(strain)
        now = np.zeros(strain.shape[1:])
        steps = np.diff(strain, axis=0) / gap / STEPS
        for row, step in enumerate(steps, start=1):
            for _ in range(STEPS):
                work = now * step
                for part in (slice(0, 2), slice(2, 3)):
                    done = work[:, part].sum(1, keepdims=True)
                    loss = beta * np.abs(done) + (1 - beta) * done
                    now[:, part] += step[:, part] - now[:, part] * loss
            found[row] = now
        return found

    relative, most = arm.relative()
    return arm.with_relative(relative - strength * gap * arm.along_runs(friction, relative), most)


def _draw_creep(arm: Arm, rng: np.random.Generator) -> Drawn:
    return {"power": float(rng.uniform(0.25, 0.6))}


def _creep(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """u + strength int ((t - t') / 10 s)^n du(t'): a spring-pot's compliance (Scott Blair 1947)."""

    def crept(strain: np.ndarray, rows: slice) -> np.ndarray:
        time = arm.t_s[rows] - arm.t_s[rows.start]
        grid = np.arange(0.0, time[-1] + KERNEL_S, KERNEL_S)
        flat = strain.reshape(len(strain), -1)
        even = np.stack([np.interp(grid, time, column) for column in flat.T], axis=1)
        steps = np.diff(even, axis=0, prepend=even[:1])
        kernel = (grid / 10.0) ** drawn["power"]
        late = fftconvolve(steps, kernel[:, None], axes=0)[: len(grid)]
        back = np.stack([np.interp(time, grid, column) for column in late.T], axis=1)
        return back.reshape(strain.shape)

    relative, most = arm.relative()
    return arm.with_relative(relative + strength * arm.along_runs(crept, relative), most)


def _draw_rate(arm: Arm, rng: np.random.Generator) -> Drawn:
    return {"share": float(rng.uniform(0.5, 0.9)), "stress": float(rng.uniform(0.05, 0.2))}


def _rate(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """u less a share of d = u - y, y' = (s / tau) sinh(d / s): exact where u stands still.

    tanh(d(t) / (2 s)) = tanh(d(0) / (2 s)) exp(-t / tau), along d; strength: tau, s.
    """
    stress = drawn["stress"]

    def carried(strain: np.ndarray, rows: slice) -> np.ndarray:
        found = np.zeros_like(strain)
        lack = np.zeros(strain.shape[1:])
        steps = np.diff(strain, axis=0)
        times = np.diff(arm.t_s[rows])
        for row, (step, time) in enumerate(zip(steps, times, strict=True), start=1):
            for _ in range(STEPS):
                lack = lack + step / STEPS
                for part in (slice(0, 2), slice(2, 3)):
                    size = np.linalg.norm(lack[:, part], axis=1, keepdims=True)
                    keep = np.tanh(size / (2 * stress)) * np.exp(-time / STEPS / strength)
                    less = 2 * stress * np.arctanh(np.minimum(keep, 1 - 1e-12))
                    lack[:, part] *= np.where(size > 0, less / np.where(size > 0, size, 1), 0)
            found[row] = lack
        return found

    relative, most = arm.relative()
    return arm.with_relative(relative - drawn["share"] * arm.along_runs(carried, relative), most)


def _sizes(relative: np.ndarray) -> np.ndarray:
    """(T, S, 3) size of the bending, of the bending, and of the stretch."""
    bend = np.linalg.norm(relative[..., :2], axis=2)
    return np.stack([bend, bend, np.abs(relative[..., 2])], axis=2)


def _stiffening(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """u that solves u / (1 - q^2 u^2) = free strain f: 2 f / (1 + sqrt(1 + 4 q^2 f^2)).

    Gent's (1996) limited chains with the bending for the stretch; strength: q.
    """
    relative, most = arm.relative()
    return arm.with_relative(
        2 * relative / (1 + np.sqrt(1 + 4 * (strength * _sizes(relative)) ** 2)), most
    )


def _softening(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """u exp(b sqrt(M - m)), m the size of the strain and M its largest so far; strength: b."""
    relative, most = arm.relative()

    def lacking(size: np.ndarray, rows: slice) -> np.ndarray:
        return np.maximum.accumulate(size, axis=0) - size

    lack = arm.along_runs(lacking, _sizes(relative))
    return arm.with_relative(relative * np.exp(strength * np.sqrt(lack)), most)


def _draw_stick(arm: Arm, rng: np.random.Generator) -> Drawn:
    return {"share": float(rng.uniform(0.4, 0.8)), "seed": int(rng.integers(2**31))}


def _stick_slip(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """A share of the strain stays where it stuck last, until it lacks a threshold, then jumps.

    The threshold of each stick is drawn anew, between half and one and a half of `strength`.
    """
    rng = np.random.default_rng(drawn["seed"])

    def stuck(strain: np.ndarray, rows: slice) -> np.ndarray:
        found = np.empty_like(strain)
        now = strain[0].copy()
        limit = strength * rng.uniform(0.5, 1.5, now.shape[0])
        for row, wanted in enumerate(strain):
            let_go = np.linalg.norm(wanted - now, axis=1) > limit
            now[let_go] = wanted[let_go]
            limit[let_go] = strength * rng.uniform(0.5, 1.5, int(let_go.sum()))
            found[row] = now
        return found

    relative, most = arm.relative()
    held = arm.along_runs(stuck, relative)
    return arm.with_relative(relative + drawn["share"] * (held - relative), most)


# Body ------------------------------------------------------------------------------------------


def _payload(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """A weight at the tip; strength: weight times length squared over bending stiffness."""
    node = PIECES * len(arm.rod.lengths_mm)
    weight = strength / arm.rod.lengths_mm.sum() ** 2 * arm.gravity
    return arm.points(force=Weight(weight, node))


def _draw_contact(arm: Arm, rng: np.random.Generator) -> Drawn:
    """A side towards which the support's place on the body moves far, and that place."""
    sections = len(arm.rod.lengths_mm)
    node = int(PIECES * (sections - 1) + rng.integers(2, PIECES))
    angles = np.arange(16) * 2 * np.pi / 16
    normals = np.stack([np.cos(angles), np.sin(angles), np.zeros(16)], axis=1)
    free = balanced(arm.rod, arm.rod.strains(arm.loads)).nodes[:, node]
    far = free @ normals.T
    reach = far.max(0) - np.median(far, axis=0)
    angle = float(rng.choice(angles[reach >= np.median(reach)]))
    return {"node": node, "angle_rad": angle}


def _contact(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """A support across the arm's way; strength: depth of its plane, as a share of the reach."""
    node = int(drawn["node"])
    normal = np.array([np.cos(drawn["angle_rad"]), np.sin(drawn["angle_rad"]), 0.0])
    strains = arm.rod.strains(arm.loads)
    shape = balanced(arm.rod, strains)
    far = shape.nodes[:, node] @ normal
    plane = far.max() - strength * (far.max() - far.min())
    touched = np.flatnonzero(far > plane)
    points = key_points(arm.rod, shape)
    support = Support(normal, plane, node, SUPPORT_SHARE)
    points[touched] = key_points(arm.rod, balanced(arm.rod, strains[touched], support))
    return points


def _twist(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """Torsion strength / length by the mean square of the loads."""
    strains = arm.rod.strains(arm.loads)
    torsion = strength / arm.rod.lengths_mm.sum() * np.mean(arm.loads**2, axis=1)
    strains[..., 2] += drawn["sign"] * torsion[:, None]
    return arm.points(strains=strains)


def _draw_sign(arm: Arm, rng: np.random.Generator) -> Drawn:
    return {"sign": float(rng.choice([-1.0, 1.0]))}


# Frame and markers -----------------------------------------------------------------------------


def _direction(rng: np.random.Generator) -> list[float]:
    vector = rng.normal(size=3)
    return (vector / np.linalg.norm(vector)).tolist()


def _draw_frame(arm: Arm, rng: np.random.Generator) -> Drawn:
    return {"axis": _direction(rng), "shift": _direction(rng)}


def _misalignment(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """Rotation by strength [rad] about the origin, and shift of a tenth of it times the length."""
    shift = 0.1 * strength * arm.rod.lengths_mm.sum() * np.array(drawn["shift"])
    return arm.points() @ turned(strength * np.array(drawn["axis"])).T + shift


def _draw_drift(arm: Arm, rng: np.random.Generator) -> Drawn:
    angle = rng.uniform(0, 2 * np.pi)
    return {
        "axis": [float(np.cos(angle)), float(np.sin(angle)), 0.0],
        "begin_s": float(rng.uniform(20.0, 60.0)),
    }


def _drift(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """Rotation of the base by strength log(1 + t / t_0), about an axis across the arm."""
    angle = strength * np.log1p(arm.t_s / drawn["begin_s"])
    turns = turned(angle[:, None] * np.array(drawn["axis"]))
    return np.einsum("tij,tnj->tni", turns, arm.points())


def _draw_breath(arm: Arm, rng: np.random.Generator) -> Drawn:
    return {
        "direction": _direction(rng),
        "period_s": float(rng.uniform(3.2, 5.0)),
        "phase_s": float(rng.uniform(0.0, 5.0)),
    }


def _breathing(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """The base is shifted by strength [mm] times exp(2 sin) of the phase, scaled to 0 to 1."""
    phase = 2 * np.pi * (arm.t_s - drawn["phase_s"]) / drawn["period_s"]
    wave = (np.exp(2 * np.sin(phase)) - np.exp(-2)) / (np.exp(2) - np.exp(-2))
    return arm.points() + strength * wave[:, None, None] * np.array(drawn["direction"])


def _draw_slip(arm: Arm, rng: np.random.Generator) -> Drawn:
    count = int(rng.integers(2, 6))
    times = np.sort(rng.uniform(0.05, 0.7, count))
    return {"point": int(rng.integers(1, 3)), "shares": times.tolist()}


def _marker_slip(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """A marker slides along the arm in equal jumps at a few moments; strength: mm in all."""
    strains = arm.rod.strains(arm.loads)
    shape = balanced(arm.rod, strains)
    points = key_points(arm.rod, shape)
    point = min(int(drawn["point"]), points.shape[1] - 1)
    piece = PIECES * (point + (0 if arm.rod.based else 1)) - 1
    moments = arm.t_s[0] + np.array(drawn["shares"]) * (arm.t_s[-1] - arm.t_s[0])
    slid = np.searchsorted(moments, arm.t_s, side="right") / len(moments)
    points[:, point] -= strength * slid[:, None] * shape.frames[:, piece, :, 2]
    return points


def _draw_knock(arm: Arm, rng: np.random.Generator) -> Drawn:
    return {"axis": _direction(rng), "share": float(rng.uniform(0.2, 0.6))}


def _knock(arm: Arm, drawn: Drawn, strength: float) -> np.ndarray:
    """The base is turned by strength [rad] at one moment."""
    moment = arm.t_s[0] + drawn["share"] * (arm.t_s[-1] - arm.t_s[0])
    points = arm.points()
    late = arm.t_s >= moment
    points[late] = points[late] @ turned(strength * np.array(drawn["axis"])).T
    return points


UNKNOWN = "unknown"
LAWS: dict[str, Law] = {
    "line_lag": Law("line_lag", nothing_drawn, _lag, 5.0),
    "dead_zone": Law("dead_zone", nothing_drawn, _dead_zone, 0.6),
    "gain_mismatch": Law("gain_mismatch", _draw_chamber, _gain, 0.6),
    "zero_offset": Law("zero_offset", _draw_chamber, _zero, 0.4),
    "hysteresis": Law("hysteresis", _draw_hysteresis, _hysteresis, 1.5),
    "creep": Law("creep", _draw_creep, _creep, 0.6),
    "rate_dependence": Law("rate_dependence", _draw_rate, _rate, 3.0),
    "stiffening": Law("stiffening", nothing_drawn, _stiffening, 1.5),
    "softening": Law("softening", nothing_drawn, _softening, 1.0),
    "payload": Law("payload", nothing_drawn, _payload, 2.0),
    "contact": Law("contact", _draw_contact, _contact, 0.8),
    "twist": Law("twist", _draw_sign, _twist, 3.0),
    "misalignment": Law("misalignment", _draw_frame, _misalignment, 0.2),
    "drift": Law("drift", _draw_drift, _drift, 0.1),
    "breathing": Law(UNKNOWN, _draw_breath, _breathing, 40.0),
    "stick_slip": Law(UNKNOWN, _draw_stick, _stick_slip, 0.8),
    "marker_slip": Law(UNKNOWN, _draw_slip, _marker_slip, 40.0),
    "knock": Law(UNKNOWN, _draw_knock, _knock, 0.2),
}
"""Effects by name."""
