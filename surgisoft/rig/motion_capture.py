"""Motion capture: markers on the key planes, their camera images with noise, and circle fits.

At least three markers a plane sit between the chambers (Chen et al. 2025, sec. III-B), where the
chambers' bulging moves them least. Camera noise has a white part and a slow part (an AR(1) process,
as the bundle's pose estimate wanders); a marker is lost now and then for some frames.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled


@dataclass(frozen=True)
class CameraDesign:
    """The cameras and the markers."""

    rate_Hz: float = 20.0
    """Frames a second [Hz] (Chen et al. 2025, sec. III-B)."""
    markers: int = 3
    """Markers on each key plane, one in each gap between chambers."""
    white_mm: float = 0.04
    """Standard deviation of a marker's coordinate, new in each frame [mm]."""
    slow_mm: float = 0.04
    """Standard deviation of its slow part [mm]."""
    slow_s: float = 0.4
    """Correlation time of the slow part [s]."""
    lost_per_s: float = 0.003
    """Rate at which a marker gets lost [1/s]."""
    lost_s: float = 0.25
    """Mean time until it is found again [s]."""
    bulge_mm: float = 0.15
    """Radial shift of a marker with both neighbouring chambers at the upper limit [mm]."""


class Cameras(NamedTuple):
    """Cameras and markers in numbers, for compiled code; n key planes, k markers each."""

    period: float
    """Time between frames [s]."""
    at: np.ndarray
    """(n, k, 2) markers x, y in their plane's frame [mm]."""
    swell: np.ndarray
    """(n, k, m) radial shift of a marker by the pressure in each chamber [mm/kPa]."""
    white: float
    """White noise [mm]."""
    slow: float
    """Slow noise [mm]."""
    slow_time: float
    """Its correlation time [s]."""
    lose: float
    """Chance to get lost from frame to frame."""
    find: float
    """Chance to be found again from frame to frame."""


class Tracking(NamedTuple):
    """State of the cameras from frame to frame; updated in place."""

    slow: np.ndarray
    """(n, k, 3) slow noise [mm]."""
    lost: np.ndarray
    """(n, k) 1 where a marker is lost."""
    seen: np.ndarray
    """(n, k, 3) markers of the last frame, arm base frame [mm]; NaN where lost."""
    clean: np.ndarray
    """(n, k, 3) the same without noise and losses [mm]."""


def build_cameras(
    design: CameraDesign, diameter_mm: float, chambers: int, planes: int, high_kPa: float,
    noise_scale: float, seed: int,
) -> Cameras:  # fmt: skip
    """Markers glued by hand at the arm's surface, in the gaps between the chambers."""
    rng = np.random.default_rng([seed, 0xCA])
    k = design.markers
    angle = np.pi / 2 + 2 * np.pi * (np.arange(k) + 0.5) / k
    angle = angle + np.radians(rng.normal(0.0, 2.0, (planes, k)))
    radius = diameter_mm / 2 + 1.5 + rng.normal(0.0, 0.1, (planes, k))
    at = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    centre = np.pi / 2 + 2 * np.pi * np.arange(chambers) / chambers
    near = np.clip(np.cos(angle[..., None] - centre), 0.0, None)
    swell = near * design.bulge_mm / high_kPa
    swell[0] = swell[-1] = 0.0  # the bracket and the tip cap do not bulge
    return Cameras(
        period=1.0 / design.rate_Hz,
        at=at,
        swell=np.ascontiguousarray(swell),
        white=float(noise_scale) * design.white_mm,
        slow=float(noise_scale) * design.slow_mm,
        slow_time=float(design.slow_s),
        lose=design.lost_per_s / design.rate_Hz if noise_scale > 0 else 0.0,
        find=min(1.0, 1.0 / (design.lost_s * design.rate_Hz)),
    )


def new_tracking(cameras: Cameras) -> Tracking:
    """Cameras before their first frame, every marker in sight."""
    planes, k, _ = cameras.at.shape
    return Tracking(
        slow=np.zeros((planes, k, 3)),
        lost=np.zeros((planes, k)),
        seen=np.zeros((planes, k, 3)),
        clean=np.zeros((planes, k, 3)),
    )


def normals_per_frame(cameras: Cameras) -> int:
    """Number of standard normals that one frame consumes."""
    planes, k, _ = cameras.at.shape
    return planes * k * 7


def normals_per_pause(cameras: Cameras) -> int:
    """Number of standard normals that a pause without frames consumes."""
    planes, k, _ = cameras.at.shape
    return planes * k * 3


@compiled
def wander(cameras: Cameras, tracking: Tracking, time: float, tape: np.ndarray, at: int) -> int:
    """Advance the slow noise by a time [s] without frames (exact for the AR(1) process).

    tape: standard normals, read from index `at`; returns the next index.
    """
    keep = math.exp(-time / cameras.slow_time)
    fresh = cameras.slow * math.sqrt(1.0 - keep * keep)
    slow = tracking.slow
    for p in range(slow.shape[0]):
        for k in range(slow.shape[1]):
            for d in range(3):
                slow[p, k, d] = keep * slow[p, k, d] + fresh * tape[at]
                at += 1
    return at


@compiled
def _upper_tail(z):
    return 0.5 * math.erfc(z / math.sqrt(2.0))


@compiled
def mark(
    cameras: Cameras,
    tracking: Tracking,
    centres: np.ndarray,
    frames: np.ndarray,
    pressures: np.ndarray,
) -> None:
    """Compute the true marker positions, into tracking.clean.

    centres: (n, 3) [mm]; frames: (n, 3, 3) plane axes in columns, arm base frame; pressures: (m,)
    chamber pressures [kPa].
    """
    for p in range(centres.shape[0]):
        for k in range(cameras.at.shape[1]):
            x, y = cameras.at[p, k, 0], cameras.at[p, k, 1]
            shift = 0.0
            for i in range(pressures.shape[0]):
                shift += cameras.swell[p, k, i] * pressures[i]
            grow = 1.0 + shift / math.sqrt(x * x + y * y)
            for d in range(3):
                across = frames[p, d, 0] * x + frames[p, d, 1] * y
                tracking.clean[p, k, d] = centres[p, d] + grow * across


@compiled
def look(cameras: Cameras, tracking: Tracking, tape: np.ndarray, at: int) -> int:
    """Record one camera frame: tracking.clean with noise and losses, into tracking.seen.

    tape: standard normals, read from index `at`; returns the next index.
    """
    at = wander(cameras, tracking, cameras.period, tape, at)
    for p in range(tracking.seen.shape[0]):
        for k in range(tracking.seen.shape[1]):
            chance = _upper_tail(tape[at])
            at += 1
            if tracking.lost[p, k] == 1.0:
                tracking.lost[p, k] = 0.0 if chance < cameras.find else 1.0
            elif chance < cameras.lose:
                tracking.lost[p, k] = 1.0
            for d in range(3):
                noise = tracking.slow[p, k, d] + cameras.white * tape[at]
                noisy = tracking.clean[p, k, d] + noise
                tracking.seen[p, k, d] = np.nan if tracking.lost[p, k] == 1.0 else noisy
                at += 1
    return at


@compiled
def circle_centre(points: np.ndarray, out: np.ndarray) -> None:
    """Centre (3,) [mm] of the circle through markers (k, 3) [mm] on one plane, into `out`.

    The plane is the least-squares one (normal of least spread); in it the circle is the algebraic
    fit of Kasa (1976), exact for points on a circle. NaN markers are left out; with fewer than
    three the centre is NaN.
    """
    out[:] = np.nan
    mean = np.zeros(3)
    count = 0
    for k in range(points.shape[0]):
        if not math.isnan(points[k, 0]):
            mean += points[k]
            count += 1
    if count < 3:
        return
    mean /= count
    spread = np.zeros((3, 3))
    for k in range(points.shape[0]):
        if not math.isnan(points[k, 0]):
            for a in range(3):
                for b in range(3):
                    spread[a, b] += (points[k, a] - mean[a]) * (points[k, b] - mean[b])
    normal = np.empty(3)
    _plane_normal(count, spread, normal)
    first = np.empty(3)
    big = np.argmax(np.abs(normal))
    first[:] = 0.0
    first[(big + 1) % 3] = 1.0
    first -= normal * normal[(big + 1) % 3]
    first /= math.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2)
    second = np.empty(3)
    second[0] = normal[1] * first[2] - normal[2] * first[1]
    second[1] = normal[2] * first[0] - normal[0] * first[2]
    second[2] = normal[0] * first[1] - normal[1] * first[0]
    uu, uv, vv, uz, vz = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(points.shape[0]):
        if not math.isnan(points[k, 0]):
            u, v = 0.0, 0.0
            for d in range(3):
                u += (points[k, d] - mean[d]) * first[d]
                v += (points[k, d] - mean[d]) * second[d]
            z = u * u + v * v
            uu += u * u
            uv += u * v
            vv += v * v
            uz += u * z
            vz += v * z
    det = uu * vv - uv * uv
    if det <= 1e-12 * (uu + vv) ** 2:
        return  # on a line: no circle
    cu = 0.5 * (uz * vv - vz * uv) / det
    cv = 0.5 * (vz * uu - uz * uv) / det
    for d in range(3):
        out[d] = mean[d] + cu * first[d] + cv * second[d]


@compiled(inner=True)
def _plane_normal(count, spread, normal):
    """Unit normal of the plane through `count` markers: of three exactly, of more by least squares.

    spread: (3, 3) scatter matrix of the markers.
    """
    if count > 3:
        _, vectors = np.linalg.eigh(spread)
        for d in range(3):
            normal[d] = vectors[d, 0]
        return
    # The scatter matrix of three points has rank two: cross products of its rows are normal.
    best = 0.0
    normal[:] = 0.0
    for a in range(3):
        b = (a + 1) % 3
        x = spread[a, 1] * spread[b, 2] - spread[a, 2] * spread[b, 1]
        y = spread[a, 2] * spread[b, 0] - spread[a, 0] * spread[b, 2]
        z = spread[a, 0] * spread[b, 1] - spread[a, 1] * spread[b, 0]
        size = math.sqrt(x * x + y * y + z * z)
        if size > best:
            best = size
            normal[0], normal[1], normal[2] = x / size, y / size, z / size
