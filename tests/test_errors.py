"""The message of an InputError is one printable line of bounded length."""

import io

from surgisoft.errors import LONGEST, InputError, counted, unknown_name


def test_what_a_file_holds_cannot_steer_the_terminal_or_fail_to_be_printed():
    message = str(InputError("a.toml: field '\x1b[2J\u202e\ud800\0'\nnext\r line"))
    assert message == r"a.toml: field '\x1b[2J\u202e\ud800\x00' next line"
    io.TextIOWrapper(io.BytesIO(), encoding="utf-8").write(message)


def test_a_long_message_keeps_its_beginning_and_its_end():
    message = str(InputError("a.csv: " + "x" * 10**6 + "; expected less"))
    assert len(message) < LONGEST
    assert message.startswith("a.csv: xxx")
    short = str(InputError("a.csv: " + "y" * 2000 + "; expected less"))
    assert len(short) < LONGEST
    assert short.endswith("; expected less")


def test_known_names_are_told_apart_and_only_near_ones_are_suggested():
    views = ["Clearance (mm)", "Endoscope", "Pressures, laser (kPa)"]
    said = str(unknown_name("view", "nope", views))
    assert said == (
        "unknown view 'nope': known are 'Clearance (mm)', 'Endoscope', 'Pressures, laser (kPa)'"
    )
    assert str(unknown_name("view", "Endoscpe", views)).endswith("did you mean 'Endoscope'?")
    assert str(unknown_name("task", "z", ["b1", "a1"])) == "unknown task 'z': known are a1, b1"


def test_a_count_agrees_with_its_noun():
    assert [counted(n, "key point") for n in (0, 1, 2000)] == [
        "0 key points",
        "1 key point",
        "2,000 key points",
    ]
