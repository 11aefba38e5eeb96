"""Files of episodes whose content is damaged: one line each, and no memory for what is not there.

The cases were found by `python -m benchmarks.fuzz`.
"""

import io
import json
import struct
import tracemalloc
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.scene import mesh
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.episodes import parts
from surgisoft.tasks.episodes.consistency import contradiction
from surgisoft.tasks.episodes.file import load_episode, save_episode
from surgisoft.tasks.episodes.log import EpisodeRecorder
from surgisoft.tasks.registry import make_task


@pytest.fixture(scope="module")
def members(tmp_path_factory):
    """The members of the file of a short cut, by name."""
    task = make_task("circle_ablation")
    with torch.inference_mode():
        episodes = Episodes(task, donate=True)
        state = episodes.seeded(4, 1)
        recorder = EpisodeRecorder(task, state, policy="scripted", seed=4)
        for _ in range(3):
            actions = task.script(state)
            state, outcome = episodes.step(state, actions)
            recorder.step(state, outcome, actions)
    file = tmp_path_factory.mktemp("episode") / "a.npz"
    log = recorder.log()
    changes = {"rows": np.array([2]), "starts": np.array([0, 2]), "sample": np.array([0, 5])}
    dose = replace(log.dose, **changes, dose_j_per_mm2=np.array([0.1, 0.2]))
    save_episode(replace(log, dose=dose), file)
    with zipfile.ZipFile(file) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.fixture(scope="module")
def log(members, tmp_path_factory):
    """The log in the file."""
    return load_episode(written(tmp_path_factory.mktemp("log"), members))


def written(folder, members):
    with zipfile.ZipFile(folder / "a.npz", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return folder / "a.npz"


def array(content):
    return np.load(io.BytesIO(content))


def packed(values):
    out = io.BytesIO()
    np.save(out, values)
    return out.getvalue()


def changed(values, index, value):
    values = np.array(values)
    values[index] = value
    return values


def test_an_episode_of_the_first_format_opens(members, tmp_path):
    """The former tables: one `beam`, `camera` and `view_fraction`; arms without their tools."""
    table = json.loads(array(members["table.npy"]).tobytes())
    log = table["log"]["table"]
    table["format"] = "surgisoft episode 1"
    log["driver"] = log.pop("policy")
    for arm in log["arms"]["table"].values():
        del arm["table"]["tool"]
    log["beam"] = log.pop("beams")["table"]["laser"]
    log["camera"] = log.pop("cameras")["table"]["endoscope"]
    log["view_fraction"] = log.pop("views")["table"]["endoscope"]
    text = packed(np.frombuffer(json.dumps(table).encode(), np.uint8))
    old = load_episode(written(tmp_path, members | {"table.npy": text}))
    new = load_episode(written(tmp_path, members))
    assert {name: arm.tool for name, arm in old.arms.items()} == {
        "laser": "laser",
        "endoscope": "endoscope",
    }
    np.testing.assert_array_equal(old.beams["laser"].end_mm, new.beams["laser"].end_mm)
    np.testing.assert_array_equal(old.view_fraction, new.views["endoscope"])
    assert old.cameras["endoscope"].fov_rad == new.camera.fov_rad
    assert old.policy == new.policy == "scripted"


def test_an_episode_of_the_second_format_opens(members, tmp_path):
    """The former table: `driver` in place of `policy`."""
    table = json.loads(array(members["table.npy"]).tobytes())
    table["format"] = "surgisoft episode 2"
    table["log"]["table"]["driver"] = table["log"]["table"].pop("policy")
    text = packed(np.frombuffer(json.dumps(table).encode(), np.uint8))
    assert load_episode(written(tmp_path, members | {"table.npy": text})).policy == "scripted"
    table["format"] = "surgisoft episode 3"
    text = packed(np.frombuffer(json.dumps(table).encode(), np.uint8))
    with pytest.raises(InputError, match="is not a complete episode"):
        load_episode(written(tmp_path, members | {"table.npy": text}))


DAMAGE = {
    "/time_s": (lambda a: a[:-1], r"'targets_mm' of the log has shape \(4, 1, 3\), expected \(3"),
    "/targets_mm": (lambda a: a[..., :2], "'targets_mm' of the log has shape"),
    "/actuals_mm": (lambda a: a.astype("U4"), "'actuals_mm' of the log holds <U4"),
    "/arms/laser/line_mm": (lambda a: a.reshape(-1), "'line_mm' of arm 'laser' has shape"),
    "/arms/laser/mount": (lambda a: a * np.nan, "'mount' of arm 'laser' holds NaN"),
    "/arms/laser/points_mm": (lambda a: a * 1e9, "lengths of an impossible size"),
    "/dose/faces": (lambda a: a + 10**6, "faces that its organ does not have"),
    "/dose/faces as bytes": (
        lambda a: np.full(a.shape, 2**16 - 1, np.uint16),
        "faces that its organ does not have",
    ),
    "/dose/sample": (lambda a: a - 1, "triangles that it does not have"),
    "/dose/starts": (lambda a: a + 1, "changes of the dose do not add up"),
    "/dose/rows": (lambda a: a + 100, "rows that the log does not have"),
    "/dose/station": (lambda a: a + 10**6, "stations that are not on its ring"),
    "/bodies/0/faces": (lambda a: changed(a, 0, 10**6), "faces without their vertices"),
    "/beams/laser/hits_organ": (
        lambda a: a.astype(float),
        "'hits_organ' of the beam of 'laser' holds",
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_arrays_that_disagree_are_refused(members, tmp_path, name):
    change, said = DAMAGE[name]
    assert load_episode(written(tmp_path, members)).rows == 4
    name = name.removesuffix(" as bytes") + ".npy"
    damaged = members | {name: packed(change(array(members[name])))}
    with pytest.raises(InputError, match=said):
        load_episode(written(tmp_path, damaged))


def test_a_header_that_claims_more_than_the_file_takes_no_memory(members, tmp_path):
    head = "{'descr': '<f8', 'fortran_order': False, 'shape': (100000, 1000), }".ljust(117) + "\n"
    claim = b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + head.encode()
    file = written(tmp_path, members | {"/time_s.npy": claim})
    tracemalloc.start()
    with pytest.raises(InputError, match="claims an array that is not in it"):
        load_episode(file)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100e6


def test_a_header_that_ends_early_is_refused(members, tmp_path):
    text = b"{'descr': '<f8', 'shape': (4L,"
    cut = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text
    with pytest.raises(InputError, match=r"'/time_s\.npy' has no header of \.npy"):
        load_episode(written(tmp_path, members | {"/time_s.npy": cut}))


def test_an_archive_that_unpacks_to_gigabytes_is_refused(members, tmp_path):
    file = written(tmp_path, members)
    content = bytearray(file.read_bytes())
    at = content.rindex(b"PK\x01\x02")  # the last entry of the directory: its size unpacked
    content[at + 24 : at + 28] = struct.pack("<I", 2**31)
    file.write_bytes(content)
    with pytest.raises(InputError, match=f"expected at most {2**29}"):
        load_episode(file)


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        (("log", "table", "rewards"), "x", "its rewards are not a table"),
        (("log", "table", "agents"), ["nobody"], "its agents are none of its arms"),
        (("log", "table", "dose", "table", "body"), "spleen", "a body that is not in it"),
        (("log", "table", "limits", "table"), {}, "a view without its limit"),
        (
            ("log", "table", "cameras", "table", "endoscope", "table", "range_mm"),
            [5.0, 1.0],
            "range is impossible",
        ),
        (("log", "table", "arms", "table", "laser", "table", "tool"), "knife", "unknown tool"),
        (("log", "table", "dt_s"), 10**400, "'dt_s' of the log is not a number"),
        (("format",), "\x1b[2J", r"format '\\x1b\[2J', expected"),
    ],
)
def test_a_table_with_another_value_is_refused(members, tmp_path, path, value, said):
    table = json.loads(array(members["table.npy"]).tobytes())
    node = table
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    text = np.frombuffer(json.dumps(table).encode(), np.uint8)
    with pytest.raises(InputError, match=said):
        load_episode(written(tmp_path, members | {"table.npy": packed(text)}))


def test_roles_are_those_of_scenes():
    assert parts.ROLES == mesh.ROLES


def with_arm(log, **fields):
    """The log with fields of its first arm changed."""
    name, arm = next(iter(log.arms.items()))
    return replace(log, arms=log.arms | {name: replace(arm, **fields)})


def with_body(log, **fields):
    """The log with fields of its first body changed."""
    return replace(log, bodies=(replace(log.bodies[0], **fields), *log.bodies[1:]))


def with_dose(log, **fields):
    """The log with fields of its dose changed."""
    return replace(log, dose=replace(log.dose, **fields))


def with_first(log, table, **fields):
    """The log with fields of the first entry of `beams` or `cameras` changed."""
    name, part = next(iter(getattr(log, table).items()))
    return replace(log, **{table: {name: replace(part, **fields)}})


CONTRADICTIONS = {
    "it has no rows": lambda log: replace(log, time_s=log.time_s[:0]),
    "its times do not rise": lambda log: replace(log, time_s=log.time_s[::-1].copy()),
    "its targets and actual places do not belong together": lambda log: replace(
        log, targets_mm=log.targets_mm[:, :0], actuals_mm=log.actuals_mm[:, :0]
    ),
    "it has no arms": lambda log: replace(log, arms={}, agents=()),
    "its paths have no beginnings": lambda log: replace(
        log, path_starts=np.array([0]), path_closed=None
    ),
    "its paths do not begin one after the other": lambda log: replace(
        log, path_starts=np.array([1]), path_closed=np.array([True])
    ),
    "has no body": lambda log: with_arm(
        log, **dict.fromkeys(("points_mm", "seen_mm"), np.zeros((len(log.time_s), 0, 3)))
    ),
    "a radius or a shaft of an impossible size": lambda log: with_arm(log, radius_mm=0.0),
    "its limits are not numbers": lambda log: replace(log, limits={"clearance_mm": "1"}),
    "it has a beam without the arm 'x'": lambda log: replace(
        log, beams={"x": next(iter(log.beams.values()))}
    ),
    "two of its bodies have one name": lambda log: replace(
        log, bodies=(*log.bodies, log.bodies[0])
    ),
    "an event of an unknown level 'x'": lambda log: replace(
        log, events=(parts.Event(0.0, "x", "text"),)
    ),
    "'path_mm' of the log is not an array": lambda log: replace(log, path_mm=[[0.0, 0.0, 0.0]]),
    "holds infinite numbers": lambda log: with_first(
        log, "beams", power_w=np.full(len(log.time_s), np.inf)
    ),
    "'policy' of the log is not a text": lambda log: replace(log, policy=1),
    "'seed' of the log is not an integer": lambda log: replace(log, seed=1.5),
    "the camera's range is not a pair of numbers": lambda log: with_first(
        log, "cameras", range_mm=(1.0,)
    ),
    "has an unknown role 'x'": lambda log: with_body(log, role="x"),
    "has no face": lambda log: with_body(log, faces=np.zeros((0, 3), np.int32)),
    "the dose has an unknown zone": lambda log: with_dose(log, zone=log.dose.zone + 3),
    "on a face of a negative number": lambda log: with_dose(log, faces=-1 - log.dose.faces),
    "a limit that is not above 0": lambda log: with_dose(log, cut_j_per_mm2=0.0),
    "lack the one of the clearance": lambda log: replace(log, limits={"time_s": 1.0}),
    "its rewards are not a table": lambda log: replace(log, rewards=[1.0]),
    "is not a number for each of": lambda log: replace(log, measures={"a": np.zeros(1)}),
}


@pytest.mark.parametrize("said", CONTRADICTIONS)
def test_a_log_that_contradicts_itself_says_where(log, said):
    assert contradiction(log) is None
    found = contradiction(CONTRADICTIONS[said](log))
    assert said in (found or "")


def test_rows_that_fall_are_refused_with_unsigned_numbers_too(log, tmp_path):
    """The difference of unsigned numbers is never below 0."""
    starts = np.array([0, 0, len(log.dose.sample)])
    for kind in (np.int64, np.uint8):
        changed = with_dose(log, rows=np.array([2, 1], kind), starts=starts)
        save_episode(changed, tmp_path / "fall.npz")
        with pytest.raises(InputError, match="changes in rows that the log does not have"):
            load_episode(tmp_path / "fall.npz")
