"""The benchmark of the endoscope's images draws every kind of image and compares speeds."""

import re

from benchmarks import images

LINE = re.compile(r" *(\d+) pixels +(.+?) +(\d+) +(\d+) +([\d.]+) x")


def test_every_kind_of_image_has_its_speed(monkeypatch, capsys):
    for name, value in (("APPROACH_STEPS", 2), ("ROUNDS", 1), ("REPLAYED", 1), ("PIXELS", (64,))):
        monkeypatch.setattr(images, name, value)
    images.main(["--envs", "2"])
    first, _, *lines = capsys.readouterr().out.splitlines()
    assert first.startswith("2 environments, 26684 faces")
    found = [LINE.fullmatch(line).groups() for line in lines]
    kinds = ["replay: rgb", "rgb", "depth", "segmentation", "rgb,depth,segmentation"]
    assert [row[:2] for row in found] == [("64", kind) for kind in kinds]
    speeds = [float(row[2]) for row in found]
    assert all(speed > 0 for speed in speeds)
    for speed, row in zip(speeds, found, strict=True):
        assert abs(float(row[4]) - speed / speeds[0]) < 0.06 + 1 / speeds[0]
