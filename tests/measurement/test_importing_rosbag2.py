"""Topics of ROS 2 bags in SQLite, of the layout that rosbag2 writes, become recordings."""

import os
import sqlite3
import tracemalloc

import pytest

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import load_recording
from tests.measurement.test_importing_mcap import MAP as MCAP_MAP
from tests.measurement.test_importing_mcap import check, imported, positions, write_bag

reader = pytest.importorskip("mcap.reader")

MAP = MCAP_MAP.replace("*.mcap", "*.db3")
TABLES = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL,
    metadata TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
    serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL,
    type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL,
    encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL,
    type_description_hash TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
    timestamp INTEGER NOT NULL, data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
"""
"""The tables of rosbag2_storage_sqlite3 from version 4 (ROS 2 Iron) on."""
NAMED = positions("/base.pose.position", "/tip.pose.position")
POSES = MAP.replace("TOPICS", 'topics = ["/tip", "/base"]').replace("POSITIONS", NAMED)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The messages of the MCAP file, the last one first, in a bag."""
    folder = tmp_path_factory.mktemp("bag")
    path = folder / "rosbag2_0.db3"
    mcap, bag = write_bag(folder / "a.mcap"), sqlite3.connect(path)
    bag.executescript(TABLES)
    numbers: dict[str, int] = {}
    with mcap.open("rb") as file:
        for schema, channel, message in [*reader.make_reader(file).iter_messages()][::-1]:
            if channel.topic not in numbers:
                numbers[channel.topic] = number = len(numbers) + 1
                kind = schema.name.replace("/", "/msg/")
                row = (number, channel.topic, kind, "cdr", "", "")
                bag.execute("INSERT INTO topics VALUES (?, ?, ?, ?, ?, ?)", row)
                row = (number, kind, "ros2msg", schema.data.decode(), "")
                bag.execute("INSERT INTO message_definitions VALUES (?, ?, ?, ?, ?)", row)
            row = (numbers[channel.topic], message.log_time, message.data)
            bag.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    bag.commit()
    bag.close()
    mcap.unlink()
    return path


@pytest.fixture
def bag(whole, tmp_path):
    """A copy of it, to be changed."""
    path = tmp_path / "bag" / "rosbag2_0.db3"
    path.parent.mkdir()
    path.write_bytes(whole.read_bytes())
    return path


def change(path, *commands):
    with sqlite3.connect(path) as bag:
        for command in commands:
            bag.execute(command)
    bag.close()


def test_a_bag_has_the_recording_of_the_mcap_file_with_its_messages(tmp_path, bag):
    check(imported(tmp_path, bag, POSES), missing=[7])
    named = positions("bodies.base.position", "bodies.tip.position")
    text = MAP.replace("TOPICS", 'topic = "/bodies"').replace("POSITIONS", named)
    check(imported(tmp_path, bag, text))


def test_the_command_imports_the_folder_and_leaves_it_as_it_was(tmp_path, bag):
    """Opened read-only: no file of SQLite's appears beside the bag."""
    (bag.parent / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: 9\n")
    (tmp_path / "map.toml").write_text(POSES)
    change(bag, "PRAGMA journal_mode = WAL")
    before = {path: path.read_bytes() for path in bag.parent.iterdir()}
    os.chmod(bag, 0o444)
    out = tmp_path / "r.parquet"
    command = ["import", str(bag.parent), "--map", str(tmp_path / "map.toml"), "-o", str(out)]
    assert run(command) == 0
    check(load_recording(out), missing=[7])
    assert {path: path.read_bytes() for path in bag.parent.iterdir()} == before


ENDLESS = (
    "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
    "SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n"
)


@pytest.mark.parametrize(
    ("commands", "said"),
    [
        (
            ["DROP TABLE message_definitions"],
            "no definition of geometry_msgs/msg/PoseStamped in the bag, as ROS 2 wrote before Iron;"
            " 'ros2 bag convert' makes an MCAP file",
        ),
        (["DELETE FROM message_definitions"], "no definition of geometry_msgs/msg/PoseStamped"),
        (
            ["UPDATE message_definitions SET encoding = 'ros2idl'"],
            "a definition in ros2idl, expected ros2msg",
        ),
        (["UPDATE topics SET serialization_format = 'x'"], "encoded as x, expected ROS 2's cdr"),
        (
            ["UPDATE topics SET name = '/other'"],
            "no message of the topic '/tip'; the file has /oth",
        ),
        (["UPDATE messages SET data = 'text'"], "got int and str, expected a time in ns and bytes"),
        (["UPDATE messages SET data = x'00010000'"], "cannot be read as a ROS 2 bag"),
        (["DROP TABLE messages"], "no table 'messages', expected a ROS 2 bag"),
        (
            ["DROP TABLE messages", f"CREATE VIEW messages AS {ENDLESS}"],
            "no table 'messages', expected a ROS 2 bag",
        ),
        (["UPDATE messages SET data = zeroblob(300000000) WHERE id = 1"], "ROS 2 bag in SQLite"),
    ],
)
def test_what_a_bag_lacks_is_one_line(tmp_path, bag, commands, said):
    change(bag, *commands)
    tracemalloc.start()
    with pytest.raises(InputError) as error:
        imported(tmp_path, bag, POSES)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    assert most < 1 << 27


def test_a_bag_that_was_not_closed_or_is_torn_is_one_line(tmp_path, bag):
    beside = bag.with_name(bag.name + "-wal")
    beside.write_bytes(b"x")
    with pytest.raises(InputError, match=r"was not closed, rosbag2_0\.db3-wal holds a part of it"):
        imported(tmp_path, bag, POSES)
    beside.unlink()
    content = bag.read_bytes()
    for torn in (content[:5000], content[: len(content) // 2], content[:16], b"text"):
        bag.write_bytes(torn)
        with pytest.raises(InputError, match=r"rosbag2_0\.db3: ") as error:
            imported(tmp_path, bag, POSES)
        assert "\n" not in str(error.value)
