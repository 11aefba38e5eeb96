"""Topics of MCAP files, written by the `mcap` packages themselves, become recordings."""

import json
import struct
import tracemalloc

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.measurement.importing import import_files, load_map
from surgisoft.measurement.recordings import load_recording

writer = pytest.importorskip("mcap_ros2.writer")

HEADER = """
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
POSE = (
    "std_msgs/Header header\ngeometry_msgs/Pose pose\n"
    + HEADER
    + """
================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
)
BODIES = (
    "std_msgs/Header header\nmocap_msgs/Body[] bodies\n"
    + HEADER
    + """
================================================================================
MSG: mocap_msgs/Body
string rigid_body_name
geometry_msgs/Point position
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
"""
)
ARRAY = "float64[] data\n"
BEGAN_S = 1_700_000_000
MAP = """

[file.cameras]
match = "*.mcap"
TOPICS

[file.valves]
match = "*.mcap"
topic = "/pressures"
join = "time"

[time]
column = "t_s"

[measured]
file = "valves"
columns = ["data.0", "data.1"]
unit = "hPa"
to = "kPa"

[key_points]
unit = "m"
positions = POSITIONS
"""


def stamp(t_s):
    whole = int(t_s)
    return {"stamp": {"sec": BEGAN_S + whole, "nanosec": round(1e9 * (t_s - whole))}}


def pressures_at(t_s):
    return [100.0 + 40.0 * t_s, 200.0 - 30.0 * t_s]


def tip_at(t_s):
    return [0.01 * t_s, 0.002, 0.07]


def write_bag(path, count=30):
    """Poses at 20 Hz that come 40 ms late, and pressures at 50 Hz that come at once."""
    with path.open("wb") as file:
        bag = writer.Writer(file)
        pose = bag.register_msgdef("geometry_msgs/PoseStamped", POSE)
        bodies = bag.register_msgdef("mocap_msgs/Bodies", BODIES)
        array = bag.register_msgdef("std_msgs/Float64MultiArray", ARRAY)

        def put(topic, schema, message, t_s):
            log_ns = round(1e9 * (BEGAN_S + t_s))
            bag.write_message(topic, schema, message, log_time=log_ns, publish_time=log_ns)

        for k in range(count):
            t_s = 0.05 * k + 0.1
            x, y, z = tip_at(t_s)
            still = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
            for topic, share in (("/base", 0.0), ("/tip", 1.0)):
                if topic == "/base" and k == 7:
                    continue
                at = {"x": share * x, "y": share * y, "z": share * z}
                message = {"header": stamp(t_s), "pose": {"position": at, "orientation": still}}
                put(topic, pose, message, t_s + 0.04)
            named = [("tip", 1.0), ("base", 0.0)] if k % 2 else [("base", 0.0), ("tip", 1.0)]
            listed = [
                {"rigid_body_name": n, "position": {"x": s * x, "y": s * y, "z": s * z}}
                for n, s in named
            ]
            put("/bodies", bodies, {"header": stamp(t_s), "bodies": listed}, t_s + 0.04)
        for k in range(100):
            t_s = 0.02 * k
            put("/pressures", array, {"data": pressures_at(t_s)}, t_s)
        bag.finish()
    return path


def check(recording, missing=()):
    t_s = recording.t_s + 0.1
    np.testing.assert_allclose(recording.t_s, 0.05 * np.arange(30), atol=1e-6)
    expected = 0.1 * np.array([pressures_at(t) for t in t_s])
    np.testing.assert_allclose(recording.measured, expected, atol=1e-5)
    tips = 1e3 * np.array([tip_at(t) for t in t_s])
    np.testing.assert_allclose(recording.key_points_mm[:, 1], tips, atol=1e-4)
    lost = np.isnan(recording.key_points_mm[:, 0]).any(axis=1)
    assert np.flatnonzero(lost).tolist() == list(missing)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("bag") / "rosbag2_0.mcap")


def imported(tmp_path, bag, text):
    (tmp_path / "map.toml").write_text(text)
    (part,) = import_files([bag], load_map(str(tmp_path / "map.toml")), "r")
    return part.recording


def positions(*prefixes):
    return json.dumps([[f"{prefix}.{axis}" for axis in "xyz"] for prefix in prefixes])


def test_poses_of_several_topics_and_pressures_of_another(tmp_path, bag):
    text = MAP.replace("TOPICS", 'topics = ["/tip", "/base"]')
    named = positions("/base.pose.position", "/tip.pose.position")
    check(imported(tmp_path, bag, text.replace("POSITIONS", named)), missing=[7])


def test_bodies_of_a_list_are_called_by_their_names(tmp_path, bag):
    text = MAP.replace("TOPICS", 'topic = "/bodies"')
    named = positions("bodies.base.position", "bodies.tip.position")
    check(imported(tmp_path, bag, text.replace("POSITIONS", named)))


def test_the_command_imports_a_folder_of_ros2_bag(tmp_path, bag):
    (bag.parent / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: 5\n")
    text = MAP.replace("TOPICS", 'topic = "/bodies"')
    named = positions("bodies.base.position", "bodies.tip.position")
    (tmp_path / "map.toml").write_text(text.replace("POSITIONS", named))
    out = tmp_path / "r.parquet"
    command = ["import", str(bag.parent), "--map", str(tmp_path / "map.toml"), "-o", str(out)]
    assert run(command) == 0
    check(load_recording(out))


def test_json_messages_without_a_header_have_the_time_of_the_log(tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "plain.mcap"
    with path.open("wb") as file:
        plain = Writer(file)
        plain.start()
        schema = plain.register_schema("reading", "jsonschema", b"{}")
        channel = plain.register_channel("/all", "json", schema)
        for k in range(5):
            content = {"p": [float(k), 2.0], "tip": {"x": 1.0, "y": 2.0, "z": 3.0 + k}}
            at = 10**9 * (5 + k)
            plain.add_message(channel, at, json.dumps(content).encode(), at)
        plain.finish()
    (tmp_path / "map.toml").write_text(
        '[file.all]\ntopic = "/all"\n[time]\ncolumn = "t_s"\n[measured]\n'
        'columns = ["p.0", "p.1"]\nunit = "kPa"\n[key_points]\nunit = "mm"\n'
        'positions = [["tip.x", "tip.y", "tip.z"]]\n'
    )
    (part,) = import_files([path], load_map(str(tmp_path / "map.toml")), "r")
    np.testing.assert_allclose(part.recording.t_s, np.arange(5.0))
    np.testing.assert_array_equal(part.recording.measured[:, 0], np.arange(5.0))
    np.testing.assert_array_equal(part.recording.key_points_mm[:, 0, 2], 3.0 + np.arange(5.0))


@pytest.mark.parametrize(
    ("topics", "message"),
    [
        ("", r'names no topic; expected topic = "/NAME" in its \[file\] table, one of /base'),
        ('topic = "/none"', r"no message of the topic '/none'; the file has /base, /bodies"),
        ('topic = "/tip"', "no column 'bodies.base.position.x', expected one of t_s, pose"),
    ],
)
def test_a_map_that_does_not_fit_is_one_line(tmp_path, bag, topics, message):
    text = MAP.replace("TOPICS", topics).replace("POSITIONS", positions("bodies.base.position"))
    with pytest.raises(InputError, match=message):
        imported(tmp_path, bag, text)


def test_a_torn_file_is_one_line(tmp_path, bag):
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(bag.read_bytes()[:2000])
    text = MAP.replace("TOPICS", 'topic = "/tip"').replace("POSITIONS", positions("pose.position"))
    with pytest.raises(InputError, match=r"torn\.mcap: cannot be read as an MCAP file"):
        imported(tmp_path, torn, text)


def test_lengths_that_a_file_claims_take_no_memory(tmp_path, bag):
    """The length of a record of the summary, and what a chunk claims to unpack to."""
    whole = bag.read_bytes()
    spec_text = MAP.replace("TOPICS", 'topic = "/tip"').replace("POSITIONS", "[['x', 'y', 'z']]")
    (tmp_path / "map.toml").write_text(spec_text)
    (size,) = struct.unpack_from("<Q", whole, 9)
    chunk = 8 + 9 + size
    while whole[chunk] != 6:
        chunk += 9 + struct.unpack_from("<Q", whole, chunk + 1)[0]
    (summary,) = struct.unpack_from("<Q", whole, len(whole) - 8 - 20)
    long_name = (1 << 32) - 1 << 32  # length of the compression's name, behind a checksum
    for damages, said in (
        ([(summary + 1, 1 << 62)], "cannot be read"),
        ([(chunk + 9 + 16, 1 << 62)], "claims to unpack to"),
        ([(chunk + 1, 1 << 62), (chunk + 9 + 24, long_name)], "cannot be read|no column"),
    ):
        damaged = bytearray(whole)
        for at, number in damages:
            struct.pack_into("<Q", damaged, at, number)
        (tmp_path / "bag.mcap").write_bytes(damaged)
        tracemalloc.start()
        with pytest.raises(InputError, match=said) as caught:
            import_files([tmp_path / "bag.mcap"], load_map(str(tmp_path / "map.toml")), "r")
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert not isinstance(caught.value.__cause__, MemoryError)
        assert most < 1 << 27


def frame_head(compression: str, size: int) -> bytes:
    """Begin of a packed frame that claims to unpack to so many bytes."""
    if compression == "zstd":  # magic number, "one segment, size in 8 bytes", the size (RFC 8878)
        return struct.pack("<IBQ", 0xFD2FB528, 0xE0, size)
    return pytest.importorskip("lz4.frame").LZ4FrameCompressor().begin(source_size=size)


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_what_a_packed_frame_claims_takes_no_memory(tmp_path, bag, compression):
    """The chunk states a harmless size, and the frame inside, which the library goes by, 16 GB."""
    text = MAP.replace("TOPICS", 'topic = "/tip"').replace("POSITIONS", "[['x', 'y', 'z']]")
    (tmp_path / "map.toml").write_text(text)
    frame = frame_head(compression, 1 << 34) + bytes(40)
    name = compression.encode()
    chunk = struct.pack("<QQQII", 0, 1, 1000, 0, len(name)) + name + struct.pack("<Q", len(frame))
    chunk += frame
    whole = bag.read_bytes()
    record = struct.pack("<BQ", 6, len(chunk)) + chunk
    (tmp_path / "bag.mcap").write_bytes(whole[:8] + record + whole[8:])
    with pytest.raises(InputError, match="claims to unpack to 17179869184"):
        import_files([tmp_path / "bag.mcap"], load_map(str(tmp_path / "map.toml")), "r")


def test_a_clock_that_jumps_by_years_takes_no_memory(tmp_path):
    """The delay's search puts runs on an even clock: not over a gap of 3 billion samples."""
    t_s = 0.05 * np.arange(400.0)
    t_s[200:] += 1e8
    waves = np.sin(np.outer(t_s % 1000.0, [1.0, 1.3, 0.7, 2.1, 1.7]))
    rows = np.column_stack([t_s, 10 + 5 * waves[:, :2], 20 * waves[:, 2:]])
    text = "".join(",".join(map(repr, row)) + "\n" for row in rows.tolist())
    (tmp_path / "raw.csv").write_text("t,u1,u2,x,y,z\n" + text)
    (tmp_path / "map.toml").write_text(
        "[file.log]\n[time]\ncolumn = 't'\n[measured]\ncolumns = ['u1', 'u2']\nunit = 'kPa'\n"
        "[key_points]\npositions = [['x', 'y', 'z']]\nunit = 'mm'\n"
    )
    (part,) = import_files([tmp_path / "raw.csv"], load_map(str(tmp_path / "map.toml")), "r")
    assert part.recording.samples == 400
