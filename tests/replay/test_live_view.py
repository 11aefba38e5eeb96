"""The live view of a run, as a file."""

import numpy as np

from surgisoft.replay.live_view import LiveBench, live_view
from tests.replay.reading import column


def test_lines_end_where_the_arm_rests_between_two_runs(tmp_path):
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 60.0]])
    with live_view(LiveBench(3, 2, "kPa", 70.0, "a bench", False), file=tmp_path / "a.rrd") as view:
        for t_s in (0.0, 0.5, 1.0, 30.0, 30.5):
            view.sample(t_s, points, points + 0.1, np.ones(3), np.ones(3), 0.2)
    for entity, count in (("pressure/measured", 3), ("residual/key_points", 2), ("alarm/level", 1)):
        held = column(tmp_path / "a.rrd", f"/plots/{entity}", "Scalars:scalars", "time")
        broken = {round(t * 1e-9, 6): len(v) for t, v in held.items() if np.isnan(v).all()}
        assert broken == {1.001: count}, entity
        assert len([t for t in held if t >= 0]) == 5 + 1, "and every sample"
