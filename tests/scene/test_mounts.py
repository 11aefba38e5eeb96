"""Which mounts of several arms go together, on arms that stand where a test puts them.

Arms are straight lines, and their ways have steps of less than a millimetre, so that every distance
is known by hand.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from surgisoft.progress import silent
from surgisoft.scene import frames, mounts
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.lesion import Ring
from surgisoft.scene.mesh import Body
from surgisoft.scene.mounted_arm import LANDED_MM, TouchPose
from surgisoft.scene.mounts import (
    EndoscopeSite,
    LaserSite,
    TipSite,
    beams_land,
    find_mounts,
    laser_sites,
)
from surgisoft.scene.reach import ArmReach
from surgisoft.scene.spec import CameraSpec, LaserSpec, LimitsSpec, MountSpec
from tests.scene.arc_table import constant_curvature_table
from tests.scene.shapes import box

TOP_MM, TIP_MM, RADIUS_MM = 10.0, 60.0, 4.0
"""Height of the organ, a plate, and of the laser's tips above the origin, and radius of all arms;
two points of the ring are 20 mm apart."""
PLACES = np.array([[-10.0, 0.0], [10.0, 0.0]])


@pytest.fixture(scope="module")
def engine():
    radii = dict.fromkeys(("laser", "laser_1", "laser_2", "endoscope", "tip", "other"), RADIUS_MM)
    return BatchedScene(
        [Body("plate", "organ", box((80, 80, 2 * TOP_MM)))], radii, most_nodes=20_000
    )


def laser_site(standoff_mm):
    """A laser that is straight above each of the two points, and beams down."""
    heights = np.linspace(TIP_MM + 80.0, TIP_MM, 9)
    lines = np.array([[[*place, height] for height in heights] for place in PLACES])
    down = np.tile([0.0, 0.0, -1.0], (2, 1))
    cut = SimpleNamespace(lines_mm=lines, standoff_mm=np.full(2, standoff_mm), directions=down)
    every = np.ones(2, bool)
    return LaserSite(None, cut, every, np.ones(2), every, 1.0, 0.0)


def across(x_mm, height_mm):
    """An arm that rests along y at x, some height above the origin."""
    line = np.array([[x_mm, y, height_mm] for y in np.linspace(-60.0, 60.0, 9)])
    return SimpleNamespace(stays_mm=line)


ROOM = RADIUS_MM + 0.1


@pytest.mark.parametrize(
    ("x_mm", "height_mm", "standoff_mm", "lands"),
    [
        (0.0, 30.0, 50.0, True),  # between the two beams
        (10.0 - ROOM, 30.0, 50.0, True),
        (10.0, 30.0, 50.0, False),  # in the way of the second beam alone
        (-10.0, 30.0, 50.0, False),
        (10.0 - RADIUS_MM + 0.1, 30.0, 50.0, False),  # its skin, not its axis
        (10.0, TIP_MM + 40.0, 50.0, True),  # behind the tips
        (10.0, 0.0, 50.0, True),  # below the surface that the beam ends at
        (0.0, 30.0, 50.0 + 1.1 * LANDED_MM, False),  # the organ, but elsewhere
        (0.0, 30.0, 50.0 - 1.1 * LANDED_MM, False),
        (0.0, 30.0, 50.0 + 0.9 * LANDED_MM, True),
    ],
)
@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_beam_ends_at_its_point_past_the_other_arms(
    engine, x_mm, height_mm, standoff_mm, lands, order
):
    """The beams are vertical lines, so that every distance is known by hand."""
    sites = {"laser": laser_site(standoff_mm), "other": across(x_mm, height_mm)}
    ring = SimpleNamespace(points_mm=np.column_stack((PLACES, np.full(2, TOP_MM))))
    assert beams_land(engine, sites, {"laser": np.array(order)}, ring) is lands


def test_without_a_laser_no_beam_has_to_land(engine):
    ring = SimpleNamespace(points_mm=np.zeros((2, 3)))
    assert beams_land(engine, {"other": across(0.0, 30.0)}, {}, ring)


RING = Ring(
    np.array([0.0, 0.0, TOP_MM]),
    np.array([0.0, 0.0, 1.0]),
    np.column_stack((PLACES, np.full(2, TOP_MM))),
    np.tile([0.0, 0.0, 1.0], (2, 1)),
    np.zeros(2, int),
)
LIMITS = LimitsSpec(clearance_mm=12.0)
"""More than half a step of 20 mm from one point of the ring to the other."""
ARM = SimpleNamespace(reach=SimpleNamespace(radius_mm=RADIUS_MM), pose=np.eye(4), shaft_mm=0.0)


def line(*ends):
    """(9, 3) mm: a straight line between two points."""
    return np.linspace(*np.array(ends, float), 9)


def moved(lines_mm, *shifts_mm):
    """(N, K, 3) mm: a line that goes from one place to the next in steps of at most 0.5 mm."""
    places = [np.array(shifts_mm[0], float)]
    for shift in np.array(shifts_mm[1:], float):
        steps = int(np.ceil(np.linalg.norm(shift - places[-1]) / 0.5))
        places += list(np.linspace(places[-1], shift, steps + 1)[1:])
    return np.array([lines_mm + place for place in places])


ABOVE = line((0, 0, 140), (0, 0, TIP_MM))
"""A laser that is straight above the lesion's centre."""


def laser(lines_mm=None, way_mm=None):
    """A laser that comes from 100 mm above and then works at each point of the ring."""
    lines = (
        np.array([ABOVE + np.array([*place, 0.0]) for place in PLACES])
        if lines_mm is None
        else lines_mm
    )
    towards = RING.points_mm - lines[:, -1]
    standoff = np.linalg.norm(towards, axis=1)
    every, cut = np.ones(2, bool), SimpleNamespace(lines_mm=lines, standoff_mm=standoff)
    cut.directions = towards / standoff[:, None]
    site = LaserSite(ARM, cut, every, np.full(2, 9.0), every, 9.0, 0.0)
    site.__dict__["way_mm"] = moved(ABOVE, (0, 0, 100), (0, 0, 0)) if way_mm is None else way_mm
    return site


def tip(*shifts_mm):
    """A plain tip along y that rests at the first place and goes to the others."""
    way = moved(line((0, -60, 0), (0, 60, 0)), *shifts_mm)
    return TipSite(ARM, TouchPose(np.zeros(3), way, 0.0), 9.0, True, 0.0)


def endoscope(height_mm, down):
    """An endoscope beside the lesion, whose camera looks down at it or up from it."""
    pose = np.diag([1.0, -1.0, -1.0, 1.0]) if down else np.eye(4)
    pose[:3, 3] = 0.0, 30.0, height_mm
    body = line((0, 120, height_mm), (0, 30, height_mm))
    look = SimpleNamespace(line_mm=body, pose=pose)
    site = EndoscopeSite(ARM, look, np.ones(2, bool), 9.0, mounts.WEIGHTS.covered)
    site.__dict__["way_mm"] = moved(body, (0, 40, 0), (0, 0, 0))
    return site


def together(engine, monkeypatch, sites):
    """Whether mounts that are good alone are arranged; sites: by the arm's name."""
    for tool in ("laser", "endoscope", "tip"):
        monkeypatch.setattr(mounts, f"{tool}_sites", lambda _, name, *rest: [sites[name]])
    reaches = dict.fromkeys(sites, ARM.reach)
    asked = {
        name: MountSpec(name.split("_")[0], (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), arm=name)
        for name in sites
    }
    found, shortfall = find_mounts(engine, reaches, asked, RING, LaserSpec(), CameraSpec(), LIMITS)
    assert (shortfall is None) == bool(found)
    return bool(found)


SKIN = 2 * RADIUS_MM


@pytest.mark.parametrize(
    ("places", "room"),
    [
        # At rest between the beams, below the laser; to the lesion and back from there.
        ([(0, 0, 30), (0, 0, 20)], True),
        ([(10, 0, 30), (0, 0, 20)], False),  # at rest in the way of a beam
        ([(40, 0, 30), (10, 0, 30)], True),  # the beams are off while the tip is there
        ([(10 + SKIN + 12.1, 0, 100), (40, 0, 100)], True),
        ([(10 + SKIN + 11.9, 0, 100), (40, 0, 100)], False),  # at rest beside the laser at work
        ([(SKIN + 20.0, 0, 190), (SKIN + 12.1, 0, 190)], True),
        (
            [(SKIN + 20.0, 0, 190), (SKIN + 11.9, 0, 190)],
            False,
        ),  # on its way beside the laser's rest
    ],
)
def test_a_tip_and_a_laser_take_turns(engine, monkeypatch, places, room):
    """The tip goes first, past the laser at rest; then the laser works past the tip at rest."""
    assert together(engine, monkeypatch, {"laser": laser(), "tip": tip(*places)}) is room


def leaning(*tops_mm):
    """A laser 20 mm beside the ring along y and above it, which leans back to given points."""
    heads = [np.array([x, 20.0, 30.0]) for x, _ in PLACES]
    lines = np.array([line(top, head) for top, head in zip(tops_mm, heads, strict=True)])
    centred = line((0, 40, 100), (0, 20, 30))
    return laser(lines, np.array([centred, centred]))


@pytest.mark.parametrize(
    ("tops", "room"),
    [
        # While this laser is at its first point, the other one is at x = 10, from 60 mm up.
        (((-10, 40, 100), (10, 40, 100)), True),
        (((10, 18, 100), (20, 38, 100)), False),
    ],
)
def test_two_lasers_clear_each_other_around_the_ring(engine, monkeypatch, tops, room):
    sites = {"laser_1": laser(), "laser_2": leaning(*tops)}
    assert together(engine, monkeypatch, sites) is room


@pytest.mark.parametrize(("down", "room"), [(True, True), (False, False)])
def test_an_endoscope_sees_the_ring_while_the_laser_goes_round(engine, monkeypatch, down, room):
    sites = {"laser": laser(), "endoscope": endoscope(60.0, down)}
    assert together(engine, monkeypatch, sites) is room


@pytest.mark.parametrize(
    ("miss_mm", "gap_mm", "good"),
    [(0.0, 5.1, True), (9.0, 5.1, False), (0.0, 4.9, False)],
)
def test_a_tip_reaches_the_lesion_with_its_clearance(engine, monkeypatch, miss_mm, gap_mm, good):
    """Whether the tip comes to its place, and whether it keeps 5 mm from the plate on its way."""
    way = moved(line((0, -60, 0), (0, 60, 0)), (0, 0, 60), (0, 0, TOP_MM + RADIUS_MM + gap_mm))
    touch = TouchPose(np.zeros(3), way, miss_mm)
    monkeypatch.setattr(mounts, "touch_lesion", lambda *given: touch)
    monkeypatch.setattr(mounts, "MOST_EVALUATED", 20)
    reach = ArmReach(*constant_curvature_table(70.0), np.zeros(3), RADIUS_MM)
    best = mounts.tip_sites(engine, "tip", reach, RING, LimitsSpec(clearance_mm=5.0), 0.0, silent)[
        0
    ]
    assert best.good is good


def test_a_laser_cuts_from_no_pose_that_is_too_near_to_a_body(monkeypatch):
    """A post stands beside the ring: some beams land from poses too near to it, and some arms pass
    too near on their way. Distances are FCL's."""
    monkeypatch.setattr(mounts, "MOST_EVALUATED", 40)
    monkeypatch.setattr(mounts, "ROUNDS", 0)
    height_mm, count = 80.0, 6
    beside = np.array([16.0, 0.0, TOP_MM + height_mm / 2])
    plate = Body("plate", "organ", box((200.0, 200.0, 2 * TOP_MM)))
    post = box((6.0, 10.0, height_mm))
    bodies = [plate, Body("post", "support", post, frames.pose_from(np.eye(3), beside))]
    scene = BatchedScene(bodies, {"laser": RADIUS_MM}, most_nodes=20_000)
    turn = np.arange(count) * 2 * np.pi / count
    circle = np.column_stack((8 * np.cos(turn), 8 * np.sin(turn), np.full(count, TOP_MM)))
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    ring = Ring(np.array([0.0, 0.0, TOP_MM]), up[0], circle, up, np.zeros(count, int))
    table = constant_curvature_table(60.0, counts=(15, 15, 3))
    reach, limits = ArmReach(*table, np.zeros(3), RADIUS_MM), LimitsSpec(clearance_mm=3.0)
    checker = CollisionChecker(bodies)

    def too_near(lines_mm):
        shapes = [{"laser": ArmShape(each, RADIUS_MM)} for each in lines_mm]
        least = [min(checker.clearance(each).bodies_mm.values()) for each in shapes]
        return np.array(least) < limits.clearance_mm - 1e-3

    at_work = on_the_way = 0
    for site in laser_sites(scene, "laser", reach, ring, LaserSpec(), limits, 30.0, silent):
        near, way = too_near(site.cut.lines_mm), too_near(site.way_mm)
        assert not (site.good & near).any()
        assert not (site.good.any() and way.any())
        at_work += (site.landed & near & ~way.any()).sum()
        on_the_way += (site.landed & ~near & way.any()).sum()
    assert at_work > 0
    assert on_the_way > 0
