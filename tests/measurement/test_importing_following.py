"""Key points that do not follow the actuation are told; arms that follow it in any way are not."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from surgisoft.cli import run
from surgisoft.measurement.importing.following import following, following_warnings, warnings_of
from surgisoft.measurement.importing.timing import body_lead
from surgisoft.measurement.recordings import Recording
from tests.measurement.test_recording_timing import RATE_HZ, bent, lagged, played, wander

SECONDS = 200
MAP = """
[file.cam]
match = "*_cam.csv"

[file.air]
match = "*_air.csv"
join = "time"
time = "t_s"

[time]
column = "t_s"

[measured]
file = "air"
columns = ["p1_kPa", "p2_kPa", "p3_kPa"]
unit = "kPa"

[key_points]
positions = [["k0_x", "k0_y", "k0_z"], ["k1_x", "k1_y", "k1_z"]]
unit = "mm"
"""


def recorded(
    change=lambda p: p, seed=0, seconds=SECONDS, noise_mm=0.05, kind="continuous", corner_s=0.25
):
    """An arm that its changed actuation bends; noise of the cameras."""
    rng = np.random.default_rng(seed)
    p = wander(rng, seconds, corner_s=corner_s)
    points = bent(change(p))
    t_s = np.arange(len(p)) / RATE_HZ
    points = points + rng.normal(0.0, noise_mm, points.shape)
    return Recording("arm", t_s, p, points, kind=kind)


def swung(p, hz, damping):
    """The actuation through an oscillator of this frequency and damping ratio, at rest at first."""
    decay = np.exp(-damping * 2 * np.pi * hz / RATE_HZ)
    angle = 2 * np.pi * hz * np.sqrt(1 - damping**2) / RATE_HZ
    poles = [1.0, -2 * decay * np.cos(angle), decay**2]
    return lfilter([sum(poles)], poles, p - p[0], axis=0) + p[0]


FOLLOWS = {
    "at once": lambda p: p,
    "behind a lag of 1 s": lambda p: lagged(p, 1.0),
    "behind a lag of 20 s": lambda p: lagged(p, 20.0),
    "behind three lags of 0.5 s": lambda p: lagged(p, 0.5, 3),
    "with hysteresis": lambda p: played(p, 12.0),
    "with one chamber of three": lambda p: np.concatenate([p[:, :1], 0 * p[:, 1:] + 20.0], axis=1),
    "with a swing of 1 Hz": lambda p: swung(p, 1.0, 0.05),
    "with a swing of 0.4 Hz": lambda p: swung(p, 0.4, 0.1),
    "with a swing of 0.4 Hz that hardly decays": lambda p: swung(p, 0.4, 0.02),
    "beyond a dead zone": lambda p: 8 * np.maximum(p - np.quantile(p, 0.93, axis=0), 0.0),
    "up and down again": lambda p: 30 + 20 * np.sin(p / 4),
    "with creep": lambda p: p + 0.5 * lagged(p, 60.0),
}


@pytest.mark.parametrize("name", FOLLOWS)
def test_an_arm_that_follows_in_any_way_is_not_told(name):
    found = following(recorded(FOLLOWS[name]))
    assert warnings_of(found, {"measured": 0.0}) == []
    assert found.explained > 0.3


@pytest.mark.parametrize("seed", range(3))
def test_the_log_of_another_recording_is_told(seed):
    """The actuation of another seed has nothing to do with the body."""
    given = recorded(lambda p: lagged(p, 0.3), seed)
    mixed = replace(given, measured=recorded(seed=seed + 100).measured)
    found = following(mixed)
    (warning,) = warnings_of(found, {"measured": 0.0})
    assert "the key points hardly follow the actuation" in warning
    share = max(found.shifted, 0.0)
    assert f": it explains {share:.0%} of their motion (cross-validated" in warning
    assert "check that the files are of the same recording" in warning


@pytest.mark.parametrize("lag_s", [0.0, 0.1])
@pytest.mark.parametrize("offset_s", [1.4, 2.2, -1.9])
def test_clocks_apart_by_seconds_are_told_from_lags(offset_s, lag_s):
    """A body that follows after seconds, but then at once, and one that moves first."""
    rows = round(abs(offset_s) * RATE_HZ)
    late, rest = slice(rows, None), slice(None, -rows)
    given = recorded(lambda p: lagged(p, lag_s))
    body, log = (rest, late) if offset_s > 0 else (late, rest)
    apart = Recording("arm", given.t_s[rest], given.measured[log], given.key_points_mm[body])
    found = following(apart)
    assert found.apart
    assert found.shift_s == pytest.approx(offset_s + lag_s, abs=0.1)
    (warning,) = warnings_of(found, {"measured": 0.0})
    assert f"set delay_s = {-found.shift_s:.3g} in [measured]" in warning


SLOW = {
    "a lag": lambda p: lagged(p, 1.4),
    "two lags": lambda p: lagged(p, 0.7, 2),
    "three lags": lambda p: lagged(p, 0.5, 3),
    "a dead time of 0.3 s before a lag": lambda p: lagged(np.roll(p, 15, axis=0), 1.0),
    "play": lambda p: played(p, 14.0),
    "a swing of 0.3 Hz": lambda p: swung(p, 0.3, 0.6),
    "a dead time of 0.4 s": lambda p: np.roll(p, 20, axis=0),
}


@pytest.mark.parametrize("name", SLOW)
@pytest.mark.parametrize(("corner_s", "seed"), [(0.25, 0), (0.7, 1), (2.0, 0)])
def test_a_slow_arm_has_no_late_clock(name, corner_s, seed):
    """Of slow motion a shift explains most, too: a lag explains more."""
    given = recorded(SLOW[name], seed, corner_s=corner_s)
    assert following_warnings(given, {"measured": 0.0}) == []


@pytest.mark.parametrize("noise_mm", [0.0, 0.3])
@pytest.mark.parametrize("lag_s", [0.0, 1.0])
@pytest.mark.parametrize("shape", ["sine", "triangle", "circle", "lissajous"])
def test_a_periodic_motion_has_no_late_clock(shape, lag_s, noise_mm):
    """A period later the same motion comes again, as well as at once."""
    t_s = np.arange(0.0, 120.0, 1.0 / RATE_HZ)
    turn = 2 * np.pi * t_s / 6.0
    p = {
        "sine": np.sin(turn)[:, None] * [1.0, 0.0, 0.0],
        "triangle": (2 / np.pi) * np.arcsin(np.sin(turn))[:, None] * [1.0, 0.0, 0.0],
        "circle": np.stack([np.sin(turn + at) for at in (0.0, 2.1, 4.2)], axis=1),
        "lissajous": np.stack([np.sin(turn), np.sin(2 * turn), np.cos(3 * turn)], axis=1),
    }[shape]
    p = 30.0 + 20.0 * p
    noise = np.random.default_rng(1).normal(0.0, noise_mm, bent(p).shape)
    points = bent(lagged(p, lag_s) if lag_s else p) + noise
    assert following_warnings(Recording("arm", t_s, p, points), {"measured": 0.0}) == []


@pytest.mark.parametrize("offset_s", [25.0, -12.0])
def test_clocks_far_apart_are_no_other_recording(offset_s):
    """The body of a recording whose camera started later than the log, and the other way round."""
    given, rows = recorded(seconds=250), round(abs(offset_s) * RATE_HZ)
    late, rest = slice(rows, None), slice(None, -rows)
    body, log = (rest, late) if offset_s > 0 else (late, rest)
    apart = Recording("arm", given.t_s[rest], given.measured[log], given.key_points_mm[body])
    (warning,) = following_warnings(apart, {"measured": 0.0})
    assert f"{abs(offset_s):.3g} s {'late' if offset_s > 0 else 'early'}" in warning
    assert f"set delay_s = {-offset_s:.3g} in [measured]" in warning
    corrected = replace(apart, measured=given.measured[body])
    assert following_warnings(corrected, {"measured": 0.0}) == []


def test_what_a_recording_cannot_show_is_not_told():
    given = recorded()
    mixed = replace(given, measured=recorded(seed=50).measured)
    assert following(replace(mixed, kind="settled")) is None
    few = slice(0, 300)
    short = Recording("arm", mixed.t_s[few], mixed.measured[few], mixed.key_points_mm[few])
    assert following(short) is None
    noise = np.random.default_rng(0).normal(0.0, 1.0, given.key_points_mm.shape)
    assert following(replace(given, key_points_mm=noise)) is None
    assert following(replace(given, measured=np.full_like(given.measured, 10.0))) is None


@pytest.mark.parametrize("noise_mm", [0.0, 0.05])
@pytest.mark.parametrize("second", [0, 1, 60])
def test_a_single_step_shows_nothing_or_that_the_body_follows(second, noise_mm):
    """A ramp of one second, held for the rest of two minutes, to 3 decimals."""
    t_s = np.arange(2400) / 20.0
    p = np.round(50.0 * np.clip(t_s - second, 0.0, 1.0)[:, None], 3)
    noise = np.random.default_rng(0).normal(0.0, noise_mm, (2400, 2, 3))
    points = np.round(
        noise + np.array([[0.0, 10.0, 20.0], [0.0, 30.0, 40.0]]) * (p / 50)[..., None], 3
    )
    given = Recording("step", t_s, p, points)
    assert following_warnings(given, {"measured": 0.0}) == []
    assert body_lead(given) is None
    found = following(given)
    assert found is None if second < 60 else found.explained > 0.9


def test_an_import_warns_of_files_that_do_not_belong_together(tmp_path, capsys):
    """The air log of one recording, and the camera's file of another one."""
    body, air = recorded(seed=1), recorded(seed=2)
    log = np.column_stack([air.t_s, air.measured])
    header = "t_s,p1_kPa,p2_kPa,p3_kPa"
    np.savetxt(tmp_path / "a_air.csv", log, delimiter=",", header=header, comments="")
    seen = np.column_stack([body.t_s, body.key_points_mm.reshape(len(body.t_s), -1)])
    header = "t_s," + ",".join(f"k{k}_{axis}" for k in range(2) for axis in "xyz")
    np.savetxt(tmp_path / "a_cam.csv", seen, delimiter=",", header=header, comments="")
    (tmp_path / "map.toml").write_text(MAP)
    given = ["import", str(tmp_path / "a_air.csv"), str(tmp_path / "a_cam.csv")]
    asked = ["--map", str(tmp_path / "map.toml"), "-o", str(tmp_path / "a.parquet")]
    assert run([*given, *asked]) == 0
    said = capsys.readouterr()
    assert "a.parquet: the key points hardly follow the actuation" in said.out + said.err
