"""Laser ablation on the dose patch: fluence in, ablated depth and the state of the ring out.

The state goes in and comes out, batched over environments. Between two moments the beam sweeps in a
straight line from hit to hit; the dose of such a sweep has a closed form, so steps of any length
add up to the same dose. `Tissue` converts dose to depth by the blow-off model. The model has no
heat conduction and no shielding by the plume, and the surface keeps its shape.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from surgisoft.compiled import compiled
from surgisoft.errors import InputError
from surgisoft.on_device import on_device
from surgisoft.scene.batched import default_engine
from surgisoft.scene.dose_patch import HEALTHY, LESION, RING, SPACING_WAISTS, DosePatch, samples_at
from surgisoft.threads import over_rows

LIVER_WATER = 0.745
"""Mass fraction of water in liver (Woodard & White 1986, Br. J. Radiol. 59:1209, 'liver 2')."""
LIVER_DENSITY_G_PER_MM3 = 1.06e-3
"""Density of liver (Woodard & White 1986, the same table)."""
WATER_HEAT_J_PER_G_K = 4.18
"""Specific heat of water (CRC Handbook of Chemistry and Physics)."""
WATER_VAPORISATION_J_PER_G = 2257.0
"""Latent heat of water at 100 degrees C (CRC Handbook of Chemistry and Physics)."""
BODY_C = 37.0
"""Temperature of the tissue before (degrees C)."""


def vaporisation_j_per_mm3() -> float:
    """Energy (J/mm^3) that heats liver's water to 100 degrees C and vaporises all of it."""
    per_gram = WATER_HEAT_J_PER_G_K * (100.0 - BODY_C) + WATER_VAPORISATION_J_PER_G
    return LIVER_WATER * LIVER_DENSITY_G_PER_MM3 * per_gram


@dataclass(frozen=True)
class Tissue:
    """The blow-off model's two numbers (Vogel & Venugopalan 2003, Chem. Rev. 103:577, VII.A.1).

    Light falls off as Phi exp(-mu z); what absorbs more than the ablation enthalpy per volume
    goes. So ablation starts at Phi_th = h / mu and reaches ln(Phi / Phi_th) / mu deep. With h of
    full vaporisation Phi_th at 2010 nm is 43 J/cm^2; measured on fresh liver: 29 J/cm^2 (Nishioka
    & Domankevitz 1990, IEEE J. Quantum Electron. 26:2271).
    """

    absorption_per_mm: float = 9.0
    """Absorption mu of the tissue at the laser's wavelength (1/mm)."""
    enthalpy_j_per_mm3: float = vaporisation_j_per_mm3()
    """Ablation enthalpy h per volume (J/mm^3)."""

    def __post_init__(self):
        for name in ("absorption_per_mm", "enthalpy_j_per_mm3"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"tissue {name} is {getattr(self, name)}: expected more than 0")

    @property
    def threshold_j_per_mm2(self) -> float:
        """Radiant exposure at which ablation starts (J/mm^2)."""
        return self.enthalpy_j_per_mm3 / self.absorption_per_mm

    def depth_mm(self, dose_j_per_mm2: torch.Tensor) -> torch.Tensor:
        """Ablated depth (mm) after doses (J/mm^2)."""
        ratio = dose_j_per_mm2 / self.threshold_j_per_mm2
        return ratio.clamp(min=1.0).log() / self.absorption_per_mm

    def dose_for_depth(self, depth_mm: float) -> float:
        """Dose (J/mm^2) that ablates to a depth (mm)."""
        return self.threshold_j_per_mm2 * math.exp(self.absorption_per_mm * depth_mm)


def line_dose_j_per_mm2(power_w: float, waist_mm: float, speed_mm_s: float) -> float:
    """Largest dose (J/mm^2) of a beam that moves in a straight line across a flat surface once.

    The Gaussian of `sweep_fluence`, integrated along the line: sqrt(2 / pi) P / (w v).
    """
    return math.sqrt(2.0 / math.pi) * power_w / (waist_mm * speed_mm_s)


REACH_WAISTS = 2.3
"""The beam is cut off at this many 1/e^2 radii; 3e-5 of its power lies beyond."""
COARSEST_WAISTS = 0.9
"""Largest sample edge as a share of the beam's 1/e^2 radius; coarser patches would lose energy."""
STEEPEST_COSINE = 0.1
"""Faces steeper to the beam than this cosine (84 degrees) may miss its outermost part."""


Paint = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""New linear colours (N, 3) for faces (N,), points (N, 3) mm and their colours (N, 3)."""


@dataclass(frozen=True, eq=False)
class AblationState:
    """Dose and ablated areas so far: B environments, P samples, N stations; the patch's frame.

    With L beams the fields of a beam have the shape (B, L, ...) in place of (B, ...).
    """

    dose: torch.Tensor
    """(B, P) float32 J/mm^2: radiant exposure of the surface."""
    peak: torch.Tensor
    """(B, N) float32 J/mm^2: highest dose inside the ring's band at each station."""
    band_mm2: torch.Tensor
    """(B, N) float32 mm^2: ablated area of the band at each station."""
    zone_mm2: torch.Tensor
    """(B, 3) float32 mm^2: ablated area by zone (lesion, ring, healthy); of the lesion with
    `exact_lesion` the area with the dose that cuts."""
    zone_j: torch.Tensor
    """(B, 3) float32 J: energy received by zone."""
    delivered_j: torch.Tensor
    """(B,) or (B, L) float32 J: each beam's energy on the organ, on the patch or off it."""
    last_point_mm: torch.Tensor
    """(B, 3) or (B, L, 3) mm: where the beam ended at the last moment."""
    last_direction: torch.Tensor
    """(B, 3) or (B, L, 3): the beam's direction at the last moment."""
    last_on: torch.Tensor
    """(B,) or (B, L) bool: whether the beam ended on the organ at the last moment."""
    ring: torch.Tensor
    """(B,) int64: which of the map's rings is to be cut."""


_SUMS = ("dose", "peak", "band_mm2", "zone_mm2", "zone_j", "delivered_j")
"""The fields of the state that start at zero."""


@dataclass(frozen=True, eq=False)
class RingReport:
    """Progress of the cut; (B,) tensors."""

    completion: torch.Tensor
    """0..1: share of the ring that is ablated to the required depth."""
    largest_gap_mm: torch.Tensor
    """Length of the longest stretch that is not cut (mm)."""
    largest_gap_deg: torch.Tensor
    """Length of the longest uncut stretch as an angle: 360 degrees are the whole ring."""
    width_mm: torch.Tensor
    """Mean width of the cut where the ring is cut (mm), within the band; 0 for no cut."""
    healthy_mm2: torch.Tensor
    """Area of healthy tissue ablated, on the patch (mm^2), which ends `dose_patch.MARGIN_MM` beyond
    the ring."""
    healthy_j: torch.Tensor
    """Energy that went into healthy tissue, on the patch and beyond it (J)."""
    lesion_mm2: torch.Tensor
    """Area ablated inside the ring (mm^2)."""
    delivered_j: torch.Tensor
    """Energy that reached the organ (J)."""


class AblationMap:
    """Accumulates the laser's dose on a patch that has one ring or several to choose from."""

    def __init__(
        self,
        patch: DosePatch | Sequence[DosePatch],
        waist_mm: float,
        tissue: Tissue | None = None,
        depth_mm: float = 0.0,
        device: str | torch.device = "cpu",
        exact_lesion: bool = False,
    ):
        """waist_mm is the beam's 1/e^2 radius; the ring counts as cut where it is depth_mm deep.

        Several patches are the rings of `cut_patches`, which share their samples. With
        exact_lesion the area of the lesion counts from depth_mm too, instead of from the threshold
        of ablation.
        """
        self.patches = (patch,) if isinstance(patch, DosePatch) else tuple(patch)
        patch = self.patches[0]
        if not 0.0 < waist_mm < math.inf:
            raise InputError(f"laser waist is {waist_mm} mm: expected more than 0")
        if not 0.0 <= depth_mm < math.inf:
            raise InputError(f"ablation depth is {depth_mm} mm: expected 0 or more")
        if patch.spacing_mm > COARSEST_WAISTS * waist_mm:
            raise InputError(
                f"dose patch of {patch.spacing_mm:g} mm is too coarse for a waist of "
                f"{waist_mm:g} mm: cut it with a spacing of {SPACING_WAISTS * waist_mm:g} mm"
            )
        self.patch, self.waist_mm, self.tissue = patch, float(waist_mm), tissue or Tissue()
        self.threshold = self.tissue.threshold_j_per_mm2
        self.cut_dose = self.tissue.dose_for_depth(depth_mm)
        self.exact_lesion = exact_lesion
        self._counted = np.full(3, self.threshold)
        if exact_lesion:
            self._counted[LESION] = self.cut_dose
        self.device = torch.device(device)
        self._samples = [
            torch.tensor(array, device=self.device)
            for array in (patch.points_mm, patch.normals, patch.areas_mm2)
        ]
        zone, station = ([getattr(one, k) for one in self.patches] for k in ("zone", "station"))
        self._zone = torch.tensor(np.stack(zone), device=self.device, dtype=torch.int64)
        self._station = torch.tensor(np.stack(station), device=self.device)
        self._zones, self._stations = np.stack(zone), np.stack(station)
        lengths = [one.ring_length_mm for one in self.patches]
        self._ring_mm = torch.tensor(lengths, device=self.device, dtype=torch.float32)

    @property
    def zone_areas_mm2(self) -> tuple[float, float, float]:
        """Area of the patch's lesion, ring and healthy tissue (of the first ring), mm^2."""
        zone, areas = self.patch.zone, self.patch.areas_mm2
        lesion, ring, healthy = (float(areas[zone == k].sum()) for k in (LESION, RING, HEALTHY))
        return lesion, ring, healthy

    def treated(self, state: AblationState) -> tuple[torch.Tensor, torch.Tensor]:
        """(B,) J/mm^2: largest dose where it counts; (B,) 0..1: share that has the dose that cuts.

        Of the lesion's area with `exact_lesion`, else of the ring's length.
        """
        if not self.exact_lesion:
            return state.peak.amax(1), self.report(state).completion
        inside = torch.as_tensor(self.patch.zone == LESION, device=self.device)
        share = state.zone_mm2[:, LESION] / self.zone_areas_mm2[LESION]
        return state.dose[:, inside].amax(1), share

    def start(
        self,
        point_mm: torch.Tensor,
        direction: torch.Tensor,
        on: torch.Tensor,
        ring: torch.Tensor | None = None,
    ) -> AblationState:
        """Untouched tissue, the beam at (B, 3) mm along (B, 3), on the organ or not (B,) bool.

        Several beams, whose doses add up, are (B, L, 3) mm, (B, L, 3) and (B, L) bool.

        ring (B,) int64 is the number of the ring to cut; None: the first.
        """
        count, patch = len(point_mm), self.patch
        sizes = (
            (count, len(patch.areas_mm2)),
            (count, patch.stations),
            (count, patch.stations),
            (count, 3),
            (count, 3),
            tuple(point_mm.shape[:-1]),
        )
        empty = [torch.zeros(size, device=self.device) for size in sizes]
        ring = torch.zeros(count, dtype=torch.int64, device=self.device) if ring is None else ring
        sums = dict(zip(_SUMS, empty, strict=True))
        return AblationState(**sums, **self._last(*self._beam(point_mm, direction, on)), ring=ring)

    def reset(
        self,
        state: AblationState,
        mask: torch.Tensor,
        point_mm: torch.Tensor,
        direction: torch.Tensor,
        on: torch.Tensor,
        in_place: bool = False,
        ring: torch.Tensor | None = None,
    ) -> AblationState:
        """Fresh tissue where mask (B,) is set; the beam and the ring as for `start`.

        With in_place the old state's tensors are overwritten.
        """
        new = self._beam(point_mm, direction, on)
        old = (state.last_point_mm, state.last_direction, state.last_on)
        beam = (
            torch.where(mask.reshape(-1, *[1] * (o.ndim - 1)), n, o)
            for n, o in zip(new, old, strict=True)
        )
        kept = [getattr(state, name) for name in _SUMS]
        if in_place:
            # By index: a mask would be spread over every sample of every environment first.
            index = mask.nonzero()[:, 0]
            for tensor in kept:
                tensor.index_fill_(0, index, 0.0)
        else:
            kept = [_pick(mask, 0.0, tensor) for tensor in kept]
        ring = torch.zeros_like(state.ring) if ring is None else ring
        sums = dict(zip(_SUMS, kept, strict=True))
        return AblationState(**sums, **self._last(*beam), ring=torch.where(mask, ring, state.ring))

    def advance(
        self,
        state: AblationState,
        point_mm: torch.Tensor,
        direction: torch.Tensor,
        on: torch.Tensor,
        power_w: torch.Tensor | float,
        dt_s: float,
        in_place: bool = False,
    ) -> AblationState:
        """The state dt_s later, the beam having swept from its last place to this one.

        point_mm (B, 3) mm, unit direction (B, 3), on (B,) bool as for `start`; power_w a number or
        (B,), constant over the step; for several beams (B, L, 3), (B, L, 3), (B, L) and (B, L). A
        beam on the organ at one end of the step only gives half of the step's energy. With in_place
        the old state's tensors are overwritten.
        """
        point, aim, on = self._beam(point_mm, direction, on)
        power = on_device(power_w, self._ring_mm)
        both, one = on & state.last_on, on ^ state.last_on
        energy = torch.where(both, 1.0, torch.where(one, 0.5, 0.0)) * power * dt_s
        energy = torch.where(energy > 0.0, energy, 0.0)
        began = torch.where(state.last_on[..., None], state.last_point_mm, point)
        ended = torch.where(on[..., None], point, state.last_point_mm)
        before = torch.where(state.last_on[..., None], state.last_direction, aim)
        after = torch.where(on[..., None], aim, state.last_direction)
        middle = torch.nn.functional.normalize(before + after, dim=-1)
        sums = [state.dose, state.peak, state.band_mm2, state.zone_mm2, state.zone_j]
        if not in_place:
            sums = [t.clone() for t in sums]
        deposit = getattr(self, f"deposit_{default_engine(self.device)}")
        for began_of, ended_of, along, joule in _each_beam(began, ended, middle, energy):
            sums = [*deposit(began_of, ended_of, along, joule, state.ring, *sums)]
        dose, peak, band, area, zone_j = sums
        total = state.delivered_j + energy
        return AblationState(dose, peak, band, area, zone_j, total, point, aim, on, state.ring)

    @staticmethod
    def _last(point_mm, direction, on) -> dict[str, torch.Tensor]:
        """The beam as the fields of a state."""
        return {"last_point_mm": point_mm, "last_direction": direction, "last_on": on}

    def _beam(self, point_mm, direction, on):
        """The beam's end as float32, direction and flag; where either is not finite it is off."""
        point = point_mm.detach().to(self.device, torch.float32)
        aim = direction.detach().to(self.device, torch.float32)
        on = torch.as_tensor(on, device=self.device)
        finite = point.isfinite().all(-1) & aim.isfinite().all(-1)
        held = finite[..., None]
        return torch.where(held, point, 0.0), torch.where(held, aim, 0.0), on & finite

    def deposit_compiled(
        self, began, ended, direction, energy, ring, dose, peak, band, area, joule
    ):
        """Dose, peak, band, area and energy of a state after one beam of each environment.

        It is compiled and changes these arrays in place. began, ended: (B, 3) the beam's ends in
        the organ's frame, mm; direction: (B, 3) unit vectors; energy: (B,) J; the rest are fields
        of an `AblationState`.
        """
        patch, grid = self.patch, self.patch.buckets
        beams = [t.contiguous().numpy() for t in (began, ended, direction, energy, ring)]
        kept = [t.numpy() for t in (dose, peak, band, area, joule)]
        samples = (patch.points_mm, patch.normals, patch.areas_mm2, self._zones, self._stations)
        place = (grid.origin_mm, grid.cell_mm, grid.shape, grid.starts, grid.cubes)
        constants = (self.waist_mm, self._counted, samples, place)

        def deposit(part: slice) -> None:
            _deposit(*(a[part] for a in beams), *constants, *(a[part] for a in kept))

        over_rows(len(energy), deposit)
        return dose, peak, band, area, joule

    def deposit_warp(self, began, ended, direction, energy, ring, dose, peak, band, area, joule):
        """`deposit_compiled` as a Warp kernel, for accelerators; changes the arrays in place."""
        self._dose_kernel(began, ended, direction, energy, ring, (dose, peak, band, area, joule))
        return dose, peak, band, area, joule

    @cached_property
    def _dose_kernel(self):
        from surgisoft.scene.warp_dose import DoseKernel

        reach_mm = REACH_WAISTS * self.waist_mm
        limits = (self.waist_mm, reach_mm, STEEPEST_COSINE)
        return DoseKernel(self.patches, self._counted, *limits, self.device)

    def deposit_torch(self, began, ended, direction, energy, ring, dose, peak, band, area, joule):
        """`deposit_compiled` in torch, for accelerators, with all samples and nothing in place."""
        points, normals, areas = (t.float() for t in self._samples)
        size = max(1, 8_000_000 // len(points))
        for i in range(0, len(dose), size):
            part = slice(i, i + size)
            p, q, d = began[part], ended[part], direction[part]
            gain = sweep_fluence(p, q, d, energy[part], self.waist_mm, points)
            gain = gain * (-(d @ normals.T)).clamp(min=0.0)
            after = dose[part] + gain
            zone, station = self._zone[ring[part]], self._station[ring[part]]
            least = torch.as_tensor(self._counted, dtype=torch.float32, device=self.device)[zone]
            burnt = (after >= least) & (dose[part] < least)
            in_ring = zone == RING
            joule[part] = joule[part].scatter_add(1, zone, gain * areas)
            area[part] = area[part].scatter_add(1, zone, burnt * areas)
            band[part] = band[part].scatter_add(1, station, burnt * areas * in_ring)
            peak[part] = peak[part].scatter_reduce(1, station, after * in_ring, "amax")
            dose[part] = after
        return dose, peak, band, area, joule

    def report(self, state: AblationState) -> RingReport:
        """Progress of the cut in each environment."""
        length = self._ring_mm[state.ring] / self.patch.stations
        engine = default_engine(self.device)
        cut, gap, burnt = _cuts_of(engine)(state.peak, state.band_mm2, self.cut_dose)
        cut_length = cut * length
        delivered = state.delivered_j.reshape(len(cut), -1).sum(1)
        beyond = (delivered - state.zone_j.sum(1)).clamp(min=0.0)
        return RingReport(
            completion=cut / self.patch.stations,
            largest_gap_mm=gap * length,
            largest_gap_deg=gap * (360.0 / self.patch.stations),
            width_mm=torch.where(cut_length > 0.0, burnt / torch.maximum(cut_length, length), 0.0),
            healthy_mm2=state.zone_mm2[:, HEALTHY],
            healthy_j=state.zone_j[:, HEALTHY] + beyond,
            lesion_mm2=state.zone_mm2[:, LESION],
            delivered_j=delivered,
        )

    def alone(self, state: AblationState) -> LoneDose:
        """The dose of the only environment of a state with one beam, on the CPU, in kept arrays."""
        return LoneDose(self, state)

    def paint(self, state: AblationState, environment: int = 0) -> Paint:
        """For `render`: colours one environment's patch by dose, from blanched to charred."""
        dose = state.dose[environment].detach().cpu().numpy()
        share = np.clip(dose / self.threshold, 0.0, None)

        def recolour(_faces, points, colours):
            sample = samples_at(self.patch, points)
            heat = np.where(sample >= 0, share[sample], 0.0)[:, None]
            blanched = np.array([0.62, 0.50, 0.42])
            charred = np.array([0.015, 0.012, 0.010])
            pale = colours + (blanched - colours) * np.clip(heat, 0.0, 1.0)
            return np.where(heat >= 1.0, charred, pale)

        return recolour


class LoneDose:
    """The dose of one environment under one beam, in kept arrays with a batch of one in front.

    It calls the compiled loop of `AblationMap.advance`, which sets what happens.
    """

    def __init__(self, dose_map: AblationMap, state: AblationState):
        self._map, self._ring = dose_map, state.ring
        patch, grid = dose_map.patch, dose_map.patch.buckets
        names = (*_SUMS, "last_point_mm", "last_direction", "last_on")
        self._arrays = {name: getattr(state, name).numpy().copy() for name in names}
        dose, self._peak, band, self._zone_mm2, joule, self._delivered = (
            self._arrays[name] for name in _SUMS
        )
        began, ended, middle = (np.zeros((1, 3), np.float32) for _ in range(3))
        self._energy = np.zeros(1, np.float32)
        last = (self._arrays[name] for name in ("last_point_mm", "last_direction", "last_on"))
        self._sweep = (*last, began, ended, middle, self._energy)
        self._deposit = (
            *(began, ended, middle, self._energy, state.ring.numpy().copy(), dose_map.waist_mm),
            dose_map._counted,
            (patch.points_mm, patch.normals, patch.areas_mm2, dose_map._zones, dose_map._stations),
            (grid.origin_mm, grid.cell_mm, grid.shape, grid.starts, grid.cubes),
            *(dose, self._peak, band, self._zone_mm2, joule),
        )
        self._station_mm = float(dose_map._ring_mm[state.ring[0]] / patch.stations)
        self._cut_dose = np.float32(dose_map.cut_dose)

    def advance(
        self, point_mm: np.ndarray, direction: np.ndarray, on: bool, power_w: float, dt_s: float
    ) -> None:
        """The beam has swept to (1, 3) mm along (1, 3), on the organ or not, see `AblationMap`."""
        _sweep_to(point_mm, direction, on, np.float32(power_w), np.float32(dt_s), *self._sweep)
        if self._energy[0] > 0.0:
            _deposit(*self._deposit)
            self._delivered += self._energy

    def progress(self) -> tuple[float, float, float]:
        """Completion, largest gap (mm) and healthy tissue ablated (mm^2), see `RingReport`."""
        completion, gap = _ring_progress(self._peak, self._cut_dose)
        return completion, gap * self._station_mm, float(self._zone_mm2[0, HEALTHY])

    @property
    def state(self) -> AblationState:
        """A copy of the present state."""
        copies = {name: torch.from_numpy(array.copy()) for name, array in self._arrays.items()}
        return AblationState(**copies, ring=self._ring)


@compiled
def _sweep_to(
    point, aim, on, power, dt, last_point, last_aim, last_on, began, ended, middle, energy
):
    """One environment's sweep since the last place of its beam, as in `AblationMap.advance`.

    point, aim (1, 3); writes began, ended, middle (1, 3) and energy (1,), and
    sets last_point, last_aim and last_on to the present.
    """
    total = np.float32(0.0)
    for i in range(3):
        total += abs(point[0, i]) + abs(aim[0, i])
    finite = math.isfinite(total)
    on = on and finite
    was, share = last_on[0], np.float32(0.0)
    if on and was:
        share = np.float32(1.0)
    elif on != was:
        share = np.float32(0.5)
    energy[0] = max(share * power * dt, np.float32(0.0))
    size = np.float32(0.0)
    for i in range(3):
        now = point[0, i] if finite else np.float32(0.0)
        along = aim[0, i] if finite else np.float32(0.0)
        began[0, i] = last_point[0, i] if was else now
        ended[0, i] = now if on else last_point[0, i]
        before = last_aim[0, i] if was else along
        middle[0, i] = before + (along if on else last_aim[0, i])
        size += middle[0, i] * middle[0, i]
        last_point[0, i], last_aim[0, i] = now, along
    length = max(math.sqrt(size), 1e-12)
    for i in range(3):
        middle[0, i] /= length
    last_on[0] = on


@compiled
def _ring_progress(peak, cut_dose):
    """Share of a ring's stations (1, N) that is cut, and stations of its longest uncut stretch."""
    count = peak.shape[1]
    cut, longest, run = 0, 0, 0
    for k in range(2 * count):
        is_cut = peak[0, k if k < count else k - count] >= cut_dose
        cut += is_cut and k < count
        run = 0 if is_cut else run + 1
        longest = max(longest, run)
    return cut / count, min(longest, count)


def _each_beam(*fields: torch.Tensor) -> Iterator[tuple[torch.Tensor, ...]]:
    """The fields (B, ...) of each beam, from those of one beam or of L beams (B, L, ...)."""
    if fields[-1].ndim == 1:
        yield fields
        return
    for k in range(fields[-1].shape[1]):
        yield tuple(one[:, k] for one in fields)


def sweep_fluence(
    began: torch.Tensor,
    ended: torch.Tensor,
    direction: torch.Tensor,
    energy: torch.Tensor,
    waist_mm: float,
    points_mm: torch.Tensor,
) -> torch.Tensor:
    """Fluence (B, P) J/mm^2 across the beam at points (P, 3) mm, for a straight sweep.

    A Gaussian beam, 2 E / (pi w^2) exp(-2 r^2 / w^2) (Siegman 1986, section 17.1), whose axis moves
    evenly from began to ended (B, 3) mm while it points along direction (B, 3), with energy (B,) J:
    across the sweep it stays a Gaussian, along it its integral is a difference of error functions.
    """
    away = points_mm[None] - began[:, None]
    away = away - (away * direction[:, None]).sum(-1, keepdim=True) * direction[:, None]
    sweep = ended - began
    sweep = sweep - (sweep * direction).sum(-1, keepdim=True) * direction
    length = sweep.norm(dim=-1)
    unit = sweep / length.clamp(min=1e-9)[:, None]
    along = (away * unit[:, None]).sum(-1)
    across2 = (away - along[..., None] * unit[:, None]).square().sum(-1)
    peak = (2.0 * energy / (math.pi * waist_mm**2))[:, None]
    scale = math.sqrt(2.0) / waist_mm
    span = length.clamp(min=1e-3 * waist_mm)[:, None]
    mean = (torch.erf(scale * along) - torch.erf(scale * (along - span))) / (scale * span)
    moving = 0.5 * math.sqrt(math.pi) * mean
    still = torch.exp(-((scale * (along - 0.5 * length[:, None])) ** 2))
    profile = torch.where(length[:, None] > 1e-3 * waist_mm, moving, still)
    return peak * torch.exp(-((scale**2) * across2)) * profile


def _cuts_of(engine: str) -> Callable[..., tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """`cut_torch`, or what an engine has for it."""
    if engine == "warp":
        from surgisoft.scene.warp_dose import cut_warp

        return cut_warp
    return cut_compiled if engine == "compiled" else cut_torch


def cut_torch(
    peak: torch.Tensor, band_mm2: torch.Tensor, cut_dose: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Cut stations (B,), stations of the longest gap (B,) and burnt area at the cut ones (B,) mm^2.

    peak: (B, N) J/mm^2, highest dose at each station of a ring; band_mm2: (B, N) burnt there.
    """
    cut = peak >= cut_dose
    return cut.sum(1), longest_run(~cut), (band_mm2 * cut).sum(1)


def cut_compiled(
    peak: torch.Tensor, band_mm2: torch.Tensor, cut_dose: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """`cut_torch` in one compiled loop, on the CPU."""
    count = len(peak)
    cut, gap = torch.empty((2, count), dtype=torch.int64)
    burnt = band_mm2.new_empty(count)
    given = [t.contiguous().numpy() for t in (peak, band_mm2)]
    found = [t.numpy() for t in (cut, gap, burnt)]
    dose = given[0].dtype.type(cut_dose)
    over_rows(count, lambda rows: _cuts(*(a[rows] for a in given), dose, *(a[rows] for a in found)))
    return cut, gap, burnt


def longest_run(flags: torch.Tensor) -> torch.Tensor:
    """(B,) length of the longest run of True in rings (B, N): the last neighbours the first."""
    count = flags.shape[1]
    twice = torch.cat((flags, flags), 1)
    place = torch.arange(1, 2 * count + 1, device=flags.device)
    broken = torch.where(twice, 0, place).cummax(1).values
    return (place - broken).amax(1).clamp(max=count)


@compiled
def _cuts(peak, band, cut_dose, cut, gap, burnt):
    """Cut stations, longest gap and burnt area of rings (B, N), see `cut_torch`, each into (B,)."""
    count = peak.shape[1]
    for n in range(len(cut)):
        done, longest, run, first, area = 0, 0, 0, -1, np.float32(0.0)
        for k in range(count):
            if peak[n, k] >= cut_dose:
                done += 1
                area += band[n, k]
                first = k if first < 0 else first
                run = 0
            else:
                run += 1
                longest = max(longest, run)
        # The gap that goes on from the last station to the first.
        cut[n], burnt[n] = done, area
        gap[n] = max(longest, run + first) if first >= 0 else count


def _pick(mask, fresh, old):
    """fresh where mask (B,) is set, else old (B, ...)."""
    return torch.where(mask.reshape(-1, *[1] * (old.ndim - 1)), fresh, old)


@compiled
def _deposit(
    began,
    ended,
    direction,
    energy,
    ring,
    waist,
    counted,
    samples,
    place,
    dose,
    peak,
    band,
    area,
    joule,
):
    """Add each environment's sweep to the samples near its path; see `sweep_fluence`."""
    points, normals, areas, zones, stations = samples
    origin, cell, shape, starts, cubes = place
    scale = math.sqrt(2.0) / waist
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(len(energy)):
        if not energy[n] > 0.0:
            continue
        zone, station = zones[ring[n]], stations[ring[n]]
        d0, d1, d2 = direction[n, 0], direction[n, 1], direction[n, 2]
        reach = REACH_WAISTS * waist
        for i in range(3):
            # Where the beam meets steep faces the lit patch is longer along the beam.
            tall = reach * (1.0 + abs(direction[n, i]) / STEEPEST_COSINE)
            near = min(began[n, i], ended[n, i]) - tall - origin[i]
            far = max(began[n, i], ended[n, i]) + tall - origin[i]
            low[i] = max(0, math.floor(max(near / cell, -1.0)))
            high[i] = min(shape[i] - 1, math.floor(min(far / cell, 1e6)))
        if low[2] > high[2]:
            continue
        m0, m1, m2 = ended[n, 0] - began[n, 0], ended[n, 1] - began[n, 1], ended[n, 2] - began[n, 2]
        slip = m0 * d0 + m1 * d1 + m2 * d2
        m0, m1, m2 = m0 - slip * d0, m1 - slip * d1, m2 - slip * d2
        length = math.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
        moving = length > 1e-5 * waist
        if moving:
            m0, m1, m2 = m0 / length, m1 / length, m2 / length
        strength = 2.0 * energy[n] / (math.pi * waist * waist)
        for ci in range(low[0], high[0] + 1):
            for cj in range(low[1], high[1] + 1):
                row = (ci * shape[1] + cj) * shape[2]
                # Only cubes that hold samples; nine of ten along the beam are empty.
                first, end = starts[row + low[2]], starts[row + high[2] + 1]
                while first < end:
                    cube, begin = cubes[first], first
                    ck, first = cube - row, starts[cube + 1]
                    x = origin[0] + (ci + 0.5) * cell - began[n, 0]
                    y = origin[1] + (cj + 0.5) * cell - began[n, 1]
                    z = origin[2] + (ck + 0.5) * cell - began[n, 2]
                    depth = x * d0 + y * d1 + z * d2
                    along = (x * m0 + y * m1 + z * m2) if moving else 0.0
                    along = min(max(along, 0.0), length)
                    x = x - depth * d0 - along * m0
                    y = y - depth * d1 - along * m1
                    z = z - depth * d2 - along * m2
                    if x * x + y * y + z * z > (reach + 0.87 * cell) ** 2:
                        continue
                    for s in range(begin, first):
                        cosine = -(d0 * normals[s, 0] + d1 * normals[s, 1] + d2 * normals[s, 2])
                        if cosine <= 0.0:
                            continue
                        x = points[s, 0] - began[n, 0]
                        y = points[s, 1] - began[n, 1]
                        z = points[s, 2] - began[n, 2]
                        depth = x * d0 + y * d1 + z * d2
                        x, y, z = x - depth * d0, y - depth * d1, z - depth * d2
                        along = (x * m0 + y * m1 + z * m2) if moving else 0.0
                        across2 = x * x + y * y + z * z - along * along
                        if across2 > reach * reach or along < -reach or along > length + reach:
                            continue
                        profile = math.exp(-scale * scale * max(across2, 0.0))
                        if moving:
                            span = math.erf(scale * along) - math.erf(scale * (along - length))
                            profile *= 0.5 * math.sqrt(math.pi) * span / (scale * length)
                        gain = strength * profile * cosine
                        after = dose[n, s] + gain
                        kind = zone[s]
                        joule[n, kind] += gain * areas[s]
                        if after >= counted[kind] and dose[n, s] < counted[kind]:
                            area[n, kind] += areas[s]
                            if kind == RING:
                                band[n, station[s]] += areas[s]
                        if kind == RING and after > peak[n, station[s]]:
                            peak[n, station[s]] = after
                        dose[n, s] = after
