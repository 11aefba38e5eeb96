"""The error against FCL that is printed with every speed."""

import pytest

from benchmarks.budget import Rates, Row, against_fcl, markdown
from surgisoft.scene.collision import CollisionChecker


def test_the_error_is_that_between_the_engines(monkeypatch):
    found = against_fcl("circle_ablation", states=12)
    assert found.states == found.beams == 12
    assert found.contact_differs == found.beam_differs == 0
    assert found.beam_off_mm < 0.01
    assert found.far_off_mm < 0.5
    table = markdown(
        [Row("circle_ablation", 64, {"arms": 1e-6}, {"arms": 1e-6}, 1e-6)],
        Rates(1e9, 1e9, 1e9),
        {"circle_ablation": found},
    )
    assert f"## circle_ablation\n\n{found.line}\n\n| part | 64 envs |" in table
    assert "contact differs in 0; end of the beam at most" in found.line

    cast = CollisionChecker.cast

    def longer(self, origins, directions, *more, **named):
        """Every beam ends 3 mm farther on."""
        hit = cast(self, origins, directions, *more, **named)
        return hit.__class__(**{**hit.__dict__, "point_mm": hit.point_mm + 3.0 * directions})

    monkeypatch.setattr(CollisionChecker, "cast", longer)
    monkeypatch.setattr(CollisionChecker, "collisions", lambda self, arms: ["one"])
    worse = against_fcl("circle_ablation", states=12)
    assert worse.contact_differs == 12
    assert worse.beam_off_mm == pytest.approx(3.0, abs=0.01)


def test_states_near_contact_are_compared_exactly(monkeypatch):
    found = against_fcl("keyhole", states=40)
    assert found.beams == 0
    assert found.near > 20
    assert found.clearance_off_mm < 0.1
    clearance = CollisionChecker.clearance

    def thicker(self, arms):
        """Arms with 1 mm more of radius."""
        return clearance(
            self, {k: type(a)(a.centreline_mm, a.radius_mm + 1.0) for k, a in arms.items()}
        )

    monkeypatch.setattr(CollisionChecker, "clearance", thicker)
    assert against_fcl("keyhole", states=40).clearance_off_mm == pytest.approx(1.0, abs=0.1)


def test_a_task_without_a_scene_has_no_line():
    assert against_fcl("track_circle") is None
    rows = [Row("track_circle", 1, {"arms": 1e-6}, {"arms": 1e-6}, 1e-6)]
    assert "FCL" not in markdown(rows, Rates(1e9, 1e9, 1e9), {"track_circle": None})
