"""Lattice of an arm: nodes, springs and chambers of a cylinder with m chambers around its axis.

Each cross-section has 1 + 3 m nodes: the centre, the middle of each of the m radial webs that
separate the chambers, and 2 m nodes of the outer wall, one at the end of each web and one in the
middle of each chamber. Chamber i is the polygon between webs i and i + 1. Springs are

- section: outer wall, webs, and the triangle of the webs' middles, within a cross-section;
- rib: from the middle of a web to the middle of the wall of a chamber beside it;
- core: along the axis, from centre to centre; it hardly stretches;
- along: from each other node to the one above;
- right, left: diagonals of the outer wall, of either handedness;
- web: diagonals of the webs.

SI units, frame of the base, z along the arm.
"""

import itertools
from typing import NamedTuple

import numpy as np

SECTION, RIB, CORE, ALONG, RIGHT, LEFT, WEB = range(7)
"""Kinds of springs. Those from ALONG on are of the material with memory, the others are linear."""
RIGIDITY = np.array([6.0, 2.0, 8.0, 1.0, 0.4, 0.4, 0.3])
"""Rigidity of a spring of each kind over that of one along the arm [-]: fibres around the wall
bound a chamber's bulging, and along the arm it is soft."""


class Body(NamedTuple):
    """A lattice with S slabs between S + 1 cross-sections of q nodes each.

    Node number = section * q + place in the section.
    """

    nodes: np.ndarray
    """((S + 1) q, 3) positions as cast [m]."""
    ends: np.ndarray
    """(K, 2) nodes that each spring joins, in ascending order."""
    kinds: np.ndarray
    """(K,) its kind."""
    lengths: np.ndarray
    """(K,) its length as cast [m]."""
    faces: np.ndarray
    """(c, 6) places in a cross-section around each chamber of one ring, counterclockwise seen from
    the tip, the centre first."""


def make_body(length: float, radius: float, ring: int, slabs: int, turn: float) -> Body:
    """The lattice of a cylinder [m] with a ring of chambers; turn: angle of the first web [rad]."""
    step = np.pi / ring
    webs = 0.5 * radius * _around(turn + 2 * step * np.arange(ring))
    outer = radius * _around(turn + step * np.arange(2 * ring))
    section = np.concatenate([np.zeros((1, 2)), webs, outer])
    count = len(section)
    heights = length * np.arange(slabs + 1) / slabs
    nodes = np.concatenate(
        [np.tile(section, (slabs + 1, 1)), np.repeat(heights, count)[:, None]], axis=1
    )

    web = [1 + i for i in range(ring)]
    wall = [1 + ring + k for k in range(2 * ring)]
    flat: list[tuple[int, int, int]] = []
    up: list[tuple[int, int, int]] = [(i, i, ALONG if i else CORE) for i in range(count)]
    for k in range(2 * ring):
        one, two = wall[k], wall[(k + 1) % (2 * ring)]
        flat.append((one, two, SECTION))
        up += [(one, two, RIGHT), (two, one, LEFT)]
    for i in range(ring):
        flat.append((web[i], web[(i + 1) % ring], SECTION))
        flat += [(web[i], wall[(2 * i + side) % (2 * ring)], RIB) for side in (-1, 1)]
        for one, two in ((0, web[i]), (web[i], wall[2 * i])):
            flat.append((one, two, SECTION))
            up += [(one, two, WEB), (two, one, WEB)]
    springs = [
        (z * count + one, z * count + two, kind)
        for z in range(1, slabs + 1)
        for one, two, kind in flat
    ]
    springs += [
        (z * count + one, (z + 1) * count + two, kind)
        for z, (one, two, kind) in itertools.product(range(slabs), up)
    ]
    ends, kinds = np.sort(np.array(springs)[:, :2], axis=1), np.array(springs)[:, 2]
    faces = [
        [0, web[i], *(wall[(2 * i + k) % (2 * ring)] for k in range(3)), web[(i + 1) % ring]]
        for i in range(ring)
    ]
    lengths = np.linalg.norm(nodes[ends[:, 1]] - nodes[ends[:, 0]], axis=1)
    return Body(nodes, ends, kinds, lengths, np.array(faces))


def _around(angles: np.ndarray) -> np.ndarray:
    """(..., 2) unit vectors at angles [rad]."""
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)
