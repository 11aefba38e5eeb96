"""The shipped maps on recordings of two real robots, against facts known of them.

Facts: SOURCE.md beside the recordings (rows, tip difference by payload), and numbers read off the
raw files with numpy here, not with the importer.
"""

from pathlib import Path

import numpy as np
import pytest

from surgisoft.measurement.importing import import_files, load_map
from surgisoft.measurement.importing.timing import body_lead, held_period_s
from surgisoft.measurement.recordings import find_warnings, load_recording, save_recording

MAPS = Path(__file__).resolve().parents[2] / "docs" / "examples" / "maps"


def folder_of(shared, name):
    folder = shared / "data" / name
    if not folder.is_dir():
        pytest.skip(f"recordings of {name} are not here")
    return folder


@pytest.fixture(scope="module")
def trunk(shared):
    folder = folder_of(shared, "asl_trunk_payload")
    spec = load_map(str(MAPS / "asl_trunk.toml"))
    recordings = []
    for suffix in ("", "_100g"):
        files = [
            folder / "control_inputs_controlled_1.csv",
            folder / f"observations_controlled_1{suffix}.csv",
        ]
        recordings.append(import_files(files, spec, f"trunk{suffix}")[0].recording)
    return folder, recordings


def test_trunk_has_its_rows_angles_and_payload(trunk):
    folder, (empty, loaded) = trunk
    raw = np.genfromtxt(folder / "control_inputs_controlled_1.csv", delimiter=",", skip_header=1)
    for recording, payload in ((empty, 0.0), (loaded, 100.0)):
        assert (recording.samples, recording.chambers, recording.key_points) == (15000, 6, 3)
        assert recording.unit == "deg"
        np.testing.assert_array_equal(recording.commanded, raw[:, 1:])
        assert set(recording.payload_g) == {payload}
        np.testing.assert_allclose(recording.t_s[-1], 149.99)
        np.testing.assert_array_equal(recording.gravity, [0, 0, 1])


def test_trunk_hangs_along_z_with_its_discs_in_order(trunk):
    for recording in trunk[1]:
        rest = recording.key_points_mm[:20].mean(axis=0)
        assert (np.diff(rest[:, 2]) > 80).all()
        for disc in rest:  # within 5 degrees of the axis
            assert np.linalg.norm(disc[:2]) < np.tan(np.radians(5)) * disc[2]


def test_payload_moves_the_discs_as_the_source_says(trunk):
    """SOURCE.md: same-input difference of 100 g against 0 g: discs 1.4, 4.8 and 10.6 mm RMS.

    The stated numbers are rms of the Euclidean difference; spikes of the first two discs, which the
    import marks, are within the tolerance.
    """
    empty, loaded = trunk[1]
    apart = np.linalg.norm(loaded.key_points_mm - empty.key_points_mm, axis=2)
    rms = np.sqrt(np.nanmean(apart**2, axis=0))
    np.testing.assert_allclose(rms, [1.4, 4.8, 10.6], atol=0.3)


def test_motors_follow_their_command_with_the_lag_of_the_source(trunk):
    """SOURCE.md: measured angles lag the command by 22 rows."""
    recording = trunk[1][0]
    lags = range(60)
    for command, angle in zip(recording.commanded.T, recording.measured.T, strict=True):
        match = [
            np.corrcoef(command[: 15000 - 60], angle[lag : 15000 - 60 + lag])[0, 1] for lag in lags
        ]
        assert 15 <= int(np.argmax(match)) <= 29


def asu(shared):
    folder = folder_of(shared, "asu_two_segment")
    files = sorted(folder.glob("*.txt.gz"))
    assert len(files) >= 10
    return files


def test_arm_of_two_segments_keeps_every_number(shared):
    spec = load_map(str(MAPS / "asu_two_segment.toml"))
    for path in asu(shared):
        raw = np.genfromtxt(path, delimiter=",")
        (part,) = import_files([path], spec, None)
        recording = part.recording
        np.testing.assert_array_equal(recording.measured, raw[:, [4, 5, 6, 10, 11, 12]])
        np.testing.assert_array_equal(recording.commanded, raw[:, [1, 2, 3, 7, 8, 9]])
        np.testing.assert_allclose(recording.t_s, raw[:, 0] - raw[0, 0])
        base = raw[:20, 17:20]
        fresh = np.r_[True, (np.diff(raw[:, 31:34], axis=0) != 0).any(axis=1)]
        tip = recording.key_points_mm[:, 2]
        np.testing.assert_array_equal(~np.isnan(tip[:, 0]), fresh)
        k0_fresh = np.r_[True, (np.diff(base, axis=0) != 0).any(axis=1)]
        away = (raw[:, 31:34] - base[k0_fresh].mean(axis=0)) * 1000 * [1, -1, -1]
        np.testing.assert_allclose(tip[fresh], away[fresh], atol=1e-6)


def test_arm_of_two_segments_hangs_along_z(shared):
    spec = load_map(str(MAPS / "asu_two_segment.toml"))
    (part,) = import_files(asu(shared), spec, "all")
    recording = part.recording
    assert len(recording.runs) == len(asu(shared))
    for run in recording.runs:
        rest = np.nanmean(recording.key_points_mm[run][:20], axis=0)
        assert (np.diff(rest[:, 2]) > 100).all()
        assert np.linalg.norm(rest[2, :2]) < 0.2 * rest[2, 2]
    np.testing.assert_array_equal(recording.gravity, [0, 0, 1])


def test_frozen_pressures_of_april_are_found_and_none_in_january(shared):
    """SOURCE.md: apr_4 pressure readings freeze for part of the hold."""
    spec = load_map(str(MAPS / "asu_two_segment.toml"))
    for path in asu(shared):
        (part,) = import_files([path], spec, None)
        frozen = [o.text for o in find_warnings(part.recording) if "frozen" in o.text]
        assert len(frozen) == path.name.startswith("apr_4"), path.name
        if frozen:
            assert "p1_psi, p2_psi, p3_psi, p4_psi, p5_psi, p6_psi repeat bit-equal" in frozen[0]


def test_command_in_the_place_of_the_measurement(shared):
    path = asu(shared)[0]
    (measured,) = import_files([path], load_map(str(MAPS / "asu_two_segment.toml")), None)
    (commanded,) = import_files(
        [path], load_map(str(MAPS / "asu_two_segment_commanded.toml")), None
    )
    np.testing.assert_array_equal(commanded.recording.measured, measured.recording.commanded)
    assert commanded.recording.commanded is None
    np.testing.assert_array_equal(
        commanded.recording.key_points_mm, measured.recording.key_points_mm
    )


def test_imported_recording_survives_both_forms(trunk, tmp_path):
    recording = trunk[1][1]
    for suffix in (".csv", ".parquet"):
        save_recording(recording, tmp_path / f"trunk{suffix}", force=True)
        read = load_recording(tmp_path / f"trunk{suffix}", on_warning=lambda _: None)
        for name in ("t_s", "measured", "commanded", "key_points_mm", "payload_g"):
            np.testing.assert_array_equal(getattr(read, name), getattr(recording, name))


def test_trunk_motors_are_read_at_20_hz_and_then_follow_in_time(trunk):
    """Held readings put the body 0.01 to 0.02 s ahead; on a line between them it is not.

    The static quadratic map of angles to positions fits the moves of 0.05 s better so.
    """
    folder, (recording, _) = trunk
    raw = np.genfromtxt(
        folder / "observations_controlled_1.csv",
        delimiter=",",
        skip_header=1,
        usecols=range(10, 16),
    )[1:]
    changed = (np.diff(raw, axis=0) != 0).any(axis=1)
    assert np.median(np.diff(np.flatnonzero(changed))) == 5
    assert held_period_s(recording) is None
    assert body_lead(recording) is None
    points = recording.key_points_mm[:, 2]
    shares = []
    for angles in (raw, recording.measured):
        scaled = angles / 80
        pairs = [scaled[:, i] * scaled[:, j] for i in range(6) for j in range(i, 6)]
        features = np.column_stack([scaled, *pairs])
        moves, motion = features[5:] - features[:-5], points[5:] - points[:-5]
        known = ~np.isnan(motion).any(axis=1)
        fit = np.linalg.lstsq(moves[known], motion[known], rcond=None)[0]
        left = motion[known] - moves[known] @ fit
        shares.append(np.square(left).sum() / np.square(motion[known]).sum())
    assert shares[1] < 0.8 * shares[0]


def test_no_arm_here_leads_its_actuation(shared):
    folder = folder_of(shared, "asu_two_segment")
    for name in ("asu_two_segment.toml", "asu_two_segment_commanded.toml"):
        (part,) = import_files([folder], load_map(str(MAPS / name)), "asu")
        assert not any("[measured]" in note for note in part.notes)
