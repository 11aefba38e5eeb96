"""Parts of the drivers: line protocol, clocks, streams of motion capture, maps of a bench."""

import json
import math
import socket
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from surgisoft.errors import InputError
from surgisoft.rig.drivers.bench_map import BenchMap, KeyPoints, load_bench_map, map_of
from surgisoft.rig.drivers.bench_map import FrameMap as BenchFrame
from surgisoft.rig.drivers.clock import ClockMap
from surgisoft.rig.drivers.line_protocol import Data, Info, crc16, line, words_of
from surgisoft.rig.drivers.motion_capture import (
    Body,
    Frame,
    FrameReceiver,
    decode_json,
    encode_json,
    listen,
)
from surgisoft.rig.drivers.natnet import read_bodies, read_frame, read_server

STILL = np.array([0.0, 0.0, 0.0, 1.0])


def test_the_checksum_is_that_of_the_standard():
    assert crc16(b"123456789") == 0x29B1  # the check value of CRC-16/CCITT-FALSE
    assert line("HELLO") == b">HELLO*" + b"%04X" % crc16(b"HELLO") + b"\n"


@given(st.integers(0, 10**9), st.lists(st.floats(-99.0, 99.0), min_size=3, max_size=3))
def test_a_report_survives_the_line(ms, pressures):
    said = Data(ms, 7, "R", tuple(pressures), (1.0, 2.0, 3.0))
    heard = Data.read(words_of(line(said.words(), "<"), "<"), 3)
    assert (heard.ms, heard.seq, heard.state, heard.target) == (ms, 7, "R", said.target)
    np.testing.assert_allclose(heard.measured, pressures, atol=5.1e-4)
    info = Info(3, -15.0, 54.0, 300, 1000, "pump box")
    assert Info.read(words_of(line(info.words(), "<"), "<")) == info


@given(st.integers(0, 44), st.integers(1, 255))
def test_a_line_with_a_changed_byte_is_not_taken_for_whole(place, change):
    whole = line("SET 12 10.000 20.000 30.000", ">")
    raw = bytearray(whole)
    raw[place % (len(raw) - 1)] ^= change
    read = words_of(bytes(raw), ">")
    # The four digits of the checksum may change their case only.
    assert read is None or bytes(raw).upper() == whole.upper()
    assert words_of(whole, "<") is None, "the other side's"


def test_the_clock_map_follows_the_fastest_messages_and_a_drift():
    rng = np.random.default_rng(0)
    clock = ClockMap(10.0)
    assert math.isnan(clock.offset_s)
    drift = 40e-6
    for k in range(4000):
        sent = 0.01 * k
        received = 500.0 + sent * (1.0 + drift) + 0.001 + rng.exponential(0.004)
        clock.add(sent, received)
    now = 500.0 + drift * sent
    assert now < clock.offset_s < now + 0.0012
    assert clock.offset_s - now > 0.0005, "the least delay of 1 ms stays in it"


def test_the_json_stream_is_read_and_written():
    points = {"tip": np.array([1.0, 2.0, 3.0]), "k1": np.full(3, np.nan)}
    bodies = {"base": Body(np.array([4.0, 5.0, 6.0]), STILL), "b": Body(np.full(3, np.nan), STILL)}
    again = decode_json(encode_json(Frame(7, 1.25, points, bodies)))
    assert (again.number, again.t_s) == (7, 1.25)
    for name, at in points.items():
        np.testing.assert_array_equal(again.points[name], at)
    for name, body in bodies.items():
        np.testing.assert_array_equal(again.bodies[name].position_mm, body.position_mm)
    metres = decode_json(b'{"frame":1,"t":0,"unit":"m","points":{"a":[0.001,0,1]}}')
    np.testing.assert_allclose(metres.points["a"], [1.0, 0.0, 1000.0])
    cm = decode_json(b'{"frame":1,"t":0,"unit":"cm","bodies":{"b":{"position":[1,-2.5,0]}}}')
    np.testing.assert_allclose(cm.bodies["b"].position_mm, [10.0, -25.0, 0.0])
    np.testing.assert_array_equal(cm.bodies["b"].rotation, STILL)


@pytest.mark.parametrize(
    ("body", "position", "rotation"),
    [
        (b'{"position":[1,2,3],"rotation":null}', [1.0, 2.0, 3.0], [np.nan] * 4),
        (b'{"position":[0,0,0],"rotation":null,"valid":false}', [np.nan] * 3, [np.nan] * 4),
        (b'{"position":null,"rotation":[0,0,0,1]}', [np.nan] * 3, STILL),
        (b"null", [np.nan] * 3, [np.nan] * 4),
    ],
)
def test_a_body_without_a_pose_is_lost_alone(body, position, rotation):
    """The points and the other bodies of its frame are there."""
    others = b'"c":{"position":[7,8,9]}},"points":{"tip":[4,5,6]}}'
    frame = decode_json(b'{"frame":1,"t":0,"bodies":{"b":' + body + b"," + others)
    np.testing.assert_array_equal(frame.bodies["b"].position_mm, position)
    np.testing.assert_array_equal(frame.bodies["b"].rotation, rotation)
    np.testing.assert_array_equal(frame.bodies["c"].position_mm, [7.0, 8.0, 9.0])
    np.testing.assert_array_equal(frame.points["tip"], [4.0, 5.0, 6.0])
    turned = Frame(2, 0.1, {}, {"b": Body(np.ones(3), np.full(4, np.nan))})
    np.testing.assert_array_equal(decode_json(encode_json(turned)).bodies["b"].position_mm, 1.0)


@pytest.mark.parametrize(
    "packet",
    [
        b"",
        b"[1]",
        b"\xff\x00",
        b'{"frame":1}',
        b'{"frame":1,"t":"x","points":{}}',
        b'{"frame":1,"t":NaN,"points":{}}',
        b'{"frame":1,"t":0,"points":{"a":[1,2]}}',
        b'{"frame":1,"t":0,"unit":"ft","points":{"a":[1,2,3]}}',
        b'{"frame":1,"t":0,"points":3}',
        b'{"frame":1,"t":0,"bodies":{"a":{"rotation":[0,0,0,1]}}}',
    ],
)
def test_a_datagram_that_is_no_frame_is_a_value_error(packet):
    with pytest.raises(ValueError):  # noqa: PT011 (its text goes to a counter's note)
        decode_json(packet)


def natnet_frame(version, marker_flags=0):
    """A frame packed by hand, as NatNet's direct depacketisation sample reads it."""
    sized = version >= (4, 1)

    def block(count, body):
        return struct.pack("<i", count) + (struct.pack("<i", len(body)) if sized else b"") + body

    body = struct.pack("<i", 4711)
    body += block(1, b"arm\0" + struct.pack("<i6f", 2, *range(6)))
    body += block(2, struct.pack("<6f", *range(6)))
    tracked = struct.pack("<i3f4ffh", 1, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0, 0.01, 1)
    lost = struct.pack("<i3f4ffh", 2, 0.4, 0.5, 0.6, 0.0, 0.0, 0.0, 1.0, 0.01, 0)
    body += block(2, tracked + lost)
    body += block(1, struct.pack("<ii", 9, 1) + tracked)
    if sized:
        body += block(1, b"x" * 11)
    body += block(1, struct.pack("<i4fhf", (1 << 16) + 3, 1.0, 2.0, 3.0, 0.01, marker_flags, 0.0))
    body += block(1, struct.pack("<iiiff", 5, 1, 2, 1.0, 2.0))
    body += block(0, b"")
    body += struct.pack("<II", 0, 0) + struct.pack("<d", 12.5)
    body += struct.pack("<QQQ", 30_000_000, 0, 0)
    if sized:
        body += struct.pack("<II", 0, 0)
    return body + struct.pack("<hi", 0, 0)


@pytest.mark.parametrize("version", [(3, 0), (3, 1), (4, 0), (4, 1), (4, 2)])
def test_a_natnet_frame_packed_by_hand_is_read(version):
    frame = read_frame(natnet_frame(version), version, {1: "base", 2: "tip"}, 1e7)
    assert (frame.number, frame.t_s) == (4711, 3.0)
    np.testing.assert_allclose(frame.bodies["base"].position_mm, [100.0, 200.0, 300.0], rtol=1e-6)
    assert np.isnan(frame.bodies["tip"].position_mm).all(), "not tracked: its last pose is stale"
    np.testing.assert_allclose(frame.points["base.3"], [1000.0, 2000.0, 3000.0])
    assert read_frame(natnet_frame(version), version, {}).t_s == 12.5
    hidden = read_frame(natnet_frame(version, 1), version, {1: "base"})
    assert np.isnan(hidden.points["base.3"]).all()


@given(st.integers(0, 340), st.binary(max_size=4), st.sampled_from([(3, 1), (4, 1)]))
def test_a_torn_natnet_frame_is_a_value_error_or_a_frame(length, tail, version):
    whole = natnet_frame(version)
    try:
        read_frame(whole[:length] + tail, version, {1: "base"})
    except ValueError:
        return
    assert length + len(tail) >= len(whole) - 14, "only what stands behind the time may be missing"


@pytest.mark.parametrize("version", [(3, 1), (4, 0), (4, 1)])
def test_names_of_natnet_bodies_packed_by_hand_are_read(version):
    def described(kind, one):
        size = struct.pack("<i", len(one)) if version >= (4, 1) else b""
        return struct.pack("<i", kind) + size + one

    def body(name, identity):
        one = name + b"\0" + struct.pack("<ii3fi", identity, -1, 0, 0, 0, 1)
        one += struct.pack("<3fi", 1.0, 2.0, 3.0, 0)
        return described(1, one + (b"m1\0" if version >= (4, 0) else b""))

    markers = described(0, b"set\0" + struct.pack("<i", 2) + b"a\0b\0")
    payload = struct.pack("<i", 4) + markers + body(b"base", 1) + body(b"tip", 2)
    payload += described(5, b"camera\0" + bytes(28))
    assert read_bodies(payload, version) == {1: "base", 2: "tip"}


def test_what_a_natnet_server_states():
    head = b"Motive".ljust(256, b"\0") + bytes([3, 1, 0, 0, 4, 1, 0, 0])
    unicast = read_server(head + struct.pack("<QH?4B", 10_000_000, 1511, False, 239, 255, 42, 99))
    assert (unicast.name, unicast.version, unicast.clock_Hz) == ("Motive", (4, 1), 1e7)
    assert unicast.group == ""
    group = read_server(head + struct.pack("<QH?4B", 10_000_000, 1511, True, 239, 255, 42, 99))
    assert (group.group, group.data_port) == ("239.255.42.99", 1511)


MAP = """
points = ["base", "m1+m2+m3", "tip"]
channels = [2, 1, 3]
payload_g = 2.0
gravity = [0.0, 0.0, 2.0]

[frame]
body = "base"
origin_mm = [0.0, 0.0, 5.0]
rotation_deg = [0.0, 0.0, 90.0]

[arm]
length_mm = 70.0
"""


def frame_of(points, body_at=(0.0, 0.0, 0.0), rotation=STILL):
    body = Body(np.array(body_at, float), np.array(rotation, float))
    return Frame(1, 0.0, {k: np.array(v, float) for k, v in points.items()}, {"base": body})


def test_a_map_puts_markers_into_the_arms_base_frame(tmp_path):
    (tmp_path / "bench.toml").write_text(MAP)
    bench = load_bench_map(tmp_path / "bench.toml")
    assert (bench.channels, bench.payload_g, bench.arm.length_mm) == ((2, 1, 3), 2.0, 70.0)
    half = math.sqrt(0.5)  # the body is turned by 90 degrees about the cameras' x axis
    circle = {"m1": [11, 0, 0], "m2": [9, 0, 0], "m3": [10, 0, 1]}
    frame = frame_of({"tip": [10.0, 0.0, 8.0], **circle}, (10.0, 0.0, 0.0), (half, 0, 0, half))
    # In the body's axes the tip is at (0, 8, 0), from the origin at (0, 8, -5); the base frame's x
    # axis is the body's y axis.
    points = KeyPoints(bench)(frame)
    np.testing.assert_allclose(points[2], [8.0, 0.0, -5.0], atol=1e-9)
    np.testing.assert_allclose(points[0], [0.0, 0.0, -5.0], atol=1e-9)
    np.testing.assert_allclose(points[1], [0.0, 0.0, -5.0], atol=1e-9)


def test_three_turns_of_a_frame_are_about_fixed_axes_one_after_another():
    """Against SciPy's extrinsic Euler angles; a point on the base's y axis, 20 mm from it."""
    degrees, origin = (30.0, -50.0, 110.0), (7.0, -8.0, 9.0)
    turn = Rotation.from_euler("xyz", degrees, degrees=True)
    bench = BenchMap(("tip",), frame=BenchFrame(origin_mm=origin, rotation_deg=degrees))
    at = np.array(origin) + turn.apply([0.0, 20.0, 0.0])
    found = KeyPoints(bench)(Frame(1, 0.0, {"tip": at}, {}))
    np.testing.assert_allclose(found, [[0.0, 20.0, 0.0]], atol=1e-12)


def test_without_the_body_of_the_frame_nothing_is_known(tmp_path):
    (tmp_path / "bench.toml").write_text(MAP)
    read = KeyPoints(load_bench_map(tmp_path / "bench.toml"))
    lost = frame_of({"tip": [1, 2, 3], "m1": [0, 0, 1], "m2": [0, 1, 0], "m3": [1, 0, 0]})
    unknown = np.full(3, np.nan)
    for place, turn in (
        (unknown, STILL),
        (np.zeros(3), np.zeros(4)),
        (np.zeros(3), STILL * np.nan),
    ):
        lost.bodies["base"] = Body(place, turn)
        assert np.isnan(read(lost)).all()
    with pytest.raises(InputError, match=r"no 'm1' among the streamed names \(base, tip\)"):
        read.require(frame_of({"tip": [1, 2, 3]}))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "points"),
        ("points = []", "names of at least one point"),
        ('points = ["a"]\nmarker = 3', "marker"),
        ('points = ["a"]\ngravity = [0.0, 0.0, 0.0]', "a direction of three numbers, not all 0"),
    ],
)
def test_a_bad_map_is_one_line_with_its_file(tmp_path, text, message):
    (tmp_path / "bench.toml").write_text(text)
    with pytest.raises(InputError, match=rf"bench\.toml.*{message}"):
        load_bench_map(tmp_path / "bench.toml")
    with pytest.raises(InputError, match="no such file, expected the map of a bench"):
        load_bench_map(tmp_path / "none.toml")


def test_names_k0_k1_need_no_map():
    frame = frame_of({f"k{i}": [0, 0, i] for i in (10, 2, 0, 1)})
    assert map_of(frame).points == ("k0", "k1", "k2", "k10")
    with pytest.raises(InputError, match=r"not k0, k1, \.\.\. \(there are: a, base\)"):
        map_of(frame_of({"a": [0, 0, 0]}))


def test_swapped_labels_are_undone_and_fast_motion_is_not_taken_for_a_swap():
    read = KeyPoints(map_of(frame_of({f"k{i}": [0, 0, 17.0 * i] for i in range(5)})))
    rng = np.random.default_rng(0)
    for k in range(60):
        bend = 6.0 * k % 40  # the tip moves 6 mm in a frame, and jumps back by 40 mm
        true = np.array([[bend * (i / 4) ** 2, 0.0, 17.0 * i] for i in range(5)])
        seen = true + rng.normal(0.0, 0.05, true.shape)
        names = [0, 1, 2, 3, 4]
        if 20 <= k < 40:
            names = [0, 1, 3, 2, 4]
        points = {f"k{name}": seen[i] for i, name in enumerate(names)}
        if k in (25, 26):
            points["k2"] = [np.nan] * 3
        got = read(frame_of(points))
        known = np.isfinite(got).all(axis=1)
        np.testing.assert_allclose(got[known], seen[known])
        assert known.sum() == (4 if k in (25, 26) else 5)
    assert read.swaps == 2


def test_the_stream_is_documented_as_it_is_read():
    from surgisoft.rig.drivers import motion_capture

    text = motion_capture.__doc__
    example = json.loads(" ".join(text[text.index("{") : text.rindex("}") + 1].split()).replace(
        "[x, y, z]", "[1, 2, 3]").replace("[qx, qy, qz, qw]", "[0, 0, 0, 1]"))  # fmt: skip
    frame = decode_json(json.dumps(example).encode())
    assert set(frame.points) == {"tip", "k3"}
    assert np.isnan(frame.points["k3"]).all()
    np.testing.assert_array_equal(frame.bodies["base"].position_mm, [1.0, 2.0, 3.0])


def test_frames_that_come_late_or_twice_are_none_and_missing_ones_are_counted():
    """Frame 8 is late; the sender counts from 0 again while its clock goes on."""
    listening = listen("127.0.0.1", 0)
    receiver = FrameReceiver(listening, decode_json, "x")
    sent = [(7, 1.0), (9, 1.2), (9, 1.2), (8, 1.1), (0, 1.3), (1, 1.4)]
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for number, t_s in sent:
                packet = encode_json(Frame(number, t_s, {}, {}))
                sender.sendto(packet, listening.getsockname())
        first = receiver.next_from(1.0, 5.0)
        receiver.put_back(first)
        assert receiver.next_from(1.4, 5.0).number == 1
        assert receiver.newest_s == 1.4
    finally:
        receiver.close()
    assert (first.number, receiver.dropped, receiver.damaged) == (7, 1, 0)


def test_a_datagram_of_brackets_is_a_damaged_one():
    """Nested too deeply for the parser: the receiver counts it and goes on."""
    listening = listen("127.0.0.1", 0)
    receiver = FrameReceiver(listening, decode_json, "cameras")
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"[" * 60_000, listening.getsockname())
            sender.sendto(encode_json(Frame(1, 0.5, {}, {})), listening.getsockname())
        assert receiver.next_from(0.0, 5.0).number == 1
        assert receiver.damaged == 1
    finally:
        receiver.close()
