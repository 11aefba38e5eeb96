"""Which replay a path names."""

import os

from surgisoft.replay.show import MAGIC, find_replay


def test_the_newest_replay_of_a_run_is_found(tmp_path):
    (tmp_path / "replays").mkdir()
    places = [tmp_path / "replays" / "step_9.rrd", tmp_path / "replays" / "step_10.rrd"]
    places.append(tmp_path / "replay.rrd")
    for age, path in zip((30, 10, 20), places, strict=True):
        path.write_bytes(MAGIC)
        os.utime(path, (1e9 - age, 1e9 - age))
    assert find_replay(tmp_path) == places[1]
    assert find_replay(places[0]) == places[0]
