"""Wall fibres: lines along an arm's wall whose material remembers, stiffens or flows.

Each fibre carries a load u, a mixture of the loads x of the chambers: a chamber that bends the arm
shortens the wall on the other side. What a fibre holds back acts on the chambers by the transpose
of that mixture (virtual work).
"""

import math
from abc import ABC

import torch
from torch import Tensor, nn

from surgisoft.errors import InputError, unknown_name
from surgisoft.surrogate.effects.base import Effect, Quantity, Stage, amplitude, value_of
from surgisoft.surrogate.effects.beam import Sagging
from surgisoft.surrogate.effects.bent_body import ENERGIES, BentBody

RINGS = (3, 4)
"""Numbers of chambers that are assumed to stand in one ring; of other numbers nothing is known."""


class WallFibres(Effect, ABC):
    """An effect on the loads of wall fibres; a subclass calls `set_fibres` when it is built."""

    stage: Stage = "material"
    version = 2
    """Version 1 had one fibre along each chamber; 2 also has a ring of fibres and redefines
    `others`."""

    others: nn.Parameter
    """(1,) share of the other chambers; None of a section and of a body."""
    sag: nn.Parameter
    """(1,) change of the sag by the arm's own weight, mm; only of a body with `weight`."""
    bent: BentBody
    sagging: Sagging

    @property
    def follows(self) -> bool:
        """True: a wall, of loads or of the body."""
        return True

    def set_fibres(
        self,
        others: float,
        ring: bool,
        section: bool = False,
        body: str | None = None,
        weight: bool = False,
    ) -> None:
        """Choose what carries the loads; others and ring are those of `fibre_matrix`.

        section: the wall as a whole, which bends and stretches (`bend_and_stretch`), in place of
        single fibres; body: one of ENERGIES, for the body in their place, behind the network;
        weight: whether the sag of that body by its own weight changes, too. Raises InputError for
        an unknown energy, and for a weight without a body or a direction of gravity.
        """
        if body is not None and body not in ENERGIES:
            raise unknown_name("energy of the body", body, ENERGIES)
        if weight and (body is None or self.facts.gravity is None):
            missing = "body" if body is None else "direction of gravity"
            raise InputError(f"weight is true without a {missing}; expected one, or weight = false")
        self.ring, self.section = bool(ring), bool(section)
        self.body, self.weight = body, bool(weight)
        mixed = not section and body is None
        shared = nn.Parameter(torch.tensor([float(others)])) if mixed else None
        self.register_parameter("others", shared)
        if body is not None:
            self.stage = "body"
            self.bent = BentBody(self.facts.rest_mm)
        if weight:
            assert self.facts.gravity is not None
            self.sag = amplitude(1)
            self.sagging = Sagging(self.facts.rest_mm, self.facts.gravity)

    def sag_amplitude(self) -> dict[str, nn.Parameter]:
        """`sag` for `amplitudes`, where there is a weight."""
        return {"sag": self.sag} if self.weight else {}

    def sag_quantity(self) -> list[Quantity]:
        """`sag_mm` for `quantities`, where there is a weight."""
        if not self.weight:
            return []
        most = 0.5 * self.sagging.length_mm
        source = (
            "a softer wall sags more, a stiffer one less; to first order, so below half the length"
        )
        return [Quantity("sag_mm", value_of(self.sag), "mm", 0.0, most, source)]

    def body_changes(self, points: Tensor, more: Tensor) -> tuple[Tensor, ...]:
        """Displacements (..., n, 3), mm, by bending, by stretch and, with a weight, by 1 mm of sag.

        points: (..., n, 3) key points, mm; more: (..., K, 2) shares of bending and stretch that are
        added at each node, of which the mean of the first one is that of the sag.
        """
        changes = self.bent.moved(points, more)
        if not self.weight:
            return changes
        return *changes, self.sagging(points) * more[..., 0].mean(-1)[..., None, None]

    @property
    def fibres(self) -> Tensor:
        """(K, m) loads of the fibres by those of the chambers."""
        return fibre_matrix(self.others, len(self.reach), self.ring)

    def fibre_loads(self, signal: Tensor) -> Tensor:
        """(..., K) load of each fibre from the actuation (..., m)."""
        return self.load(signal) @ self.fibres.T

    def mixture(self) -> list[Quantity]:
        """The mixture of the fibres' loads for `quantities`; none of a section and of a body."""
        if self.others is None:
            return []
        source = "a mixture of shares"
        return [Quantity("others_share", value_of(self.others), "", -1.0, 1.0, source)]

    def config(self) -> dict:
        """Whether the fibres stand in a ring."""
        return {"ring": self.ring}

    @classmethod
    def migrated(cls, config: dict, version: int | None) -> dict:
        # Models that were written before versions were kept have version 2 if they name the ring.
        """The arguments of this version; raises InputError for parameters of version 1."""
        if version == 1 or (version is None and "ring" not in config):
            raise InputError(
                "an earlier surgisoft fitted its parameters, which then had another meaning"
            )
        return super().migrated(config, version)


def fibre_matrix(others: Tensor, chambers: int, ring: bool = False) -> Tensor:
    """(K, m) matrix A / |A| that gives the fibres' loads u = A x / |A| from the chambers' loads x.

    others: () or (1,) share of a neighbouring chamber's load in the load of the fibre along a
    chamber, where that chamber's share is 1. ring: 2 m fibres, one along each chamber and one
    between any two; plane sections stay plane, so that the fibre at the azimuth f carries
    c sum_i x_i + (1 - c) sum_i x_i cos(f - f_i). Otherwise m fibres, one along each chamber, with
    the same share of all others. |A| is the largest singular value, so that all fibres together
    hold back no more than there is.
    """
    m = chambers
    if m == 1:
        return torch.ones(1, 1, dtype=others.dtype, device=others.device)
    if not ring:
        eye = torch.eye(m, dtype=others.dtype, device=others.device)
        most = torch.maximum((1 + (m - 1) * others).abs(), (1 - others).abs())
        return (eye + others * (1 - eye)) / most
    near = math.cos(2 * math.pi / m)
    common = (others - near) / (1 - near)
    step = torch.arange(2 * m, dtype=others.dtype, device=others.device) * (math.pi / m)
    bent = torch.cos(step[:, None] - step[None, ::2])
    most = m * torch.maximum(math.sqrt(2.0) * common.abs(), (1 - common).abs() / math.sqrt(2.0))
    return (common + (1 - common) * bent) / most


def bend_and_stretch(load: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(bending (..., m), its square (..., 1), stretch (..., 1)) by the loads (..., m) of a ring.

    A symmetric section decouples the two (Euler-Bernoulli): the mean load stretches, what chambers
    have beyond it, or beyond the one across in a ring of four, bends. The square is 1 where one
    chamber alone is fully loaded.
    """
    m, stretch = load.shape[-1], load.mean(-1, keepdim=True)
    if m == 4:
        bend = (load - load.roll(2, dims=-1)) / 2
        return bend, 2 * bend.square().sum(-1, keepdim=True), stretch
    bend = load - stretch
    return bend, bend.square().sum(-1, keepdim=True) * m / max(m - 1, 1), stretch


def walls_tried(chambers: int, others: float) -> list[tuple[float, bool, bool]]:
    """(share of the others, ring, section) of the walls that identification tries on an arm.

    Those of `fibres_tried`, and the section of an arm whose chambers stand in a ring.
    """
    fibres = [(*some, False) for some in fibres_tried(chambers, others)]
    return [*fibres, (0.0, False, True)] if chambers in RINGS else fibres


def fibres_tried(chambers: int, others: float) -> list[tuple[float, bool]]:
    """(share of the others, ring) of the wall fibres that identification tries on an arm.

    Fibres along the chambers that carry nothing else, and a ring of fibres; where the chambers are
    not known to stand in a ring, fibres with the given share of the others instead.
    """
    if chambers == 1:
        return [(0.0, False)]
    return [(0.0, False), (0.0, True) if chambers in RINGS else (others, False)]
