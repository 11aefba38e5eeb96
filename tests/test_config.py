"""TOML into dataclasses: what comes, with defaults, and one line with its place for the rest."""

import time
from dataclasses import dataclass
from typing import Annotated, Literal

import pytest

from surgisoft.config import LARGEST_BYTES, Rule, from_table, merged, read_toml, to_table
from surgisoft.errors import InputError

POSITIVE = Rule("a positive number", lambda value: value > 0)


@dataclass(frozen=True)
class Lamp:
    power_W: Annotated[float, POSITIVE]
    colour: Literal["red", "green"] = "red"
    note: str | None = None


@dataclass(frozen=True)
class Room:
    main: Lamp
    lamps: tuple[Lamp, ...] = ()
    named: dict[str, Lamp] | None = None
    origin: tuple[float, float, float] | Literal["door"] = "door"
    size: Annotated[float | tuple[float, ...], Rule("one number or several", lambda v: v != ())] = 1
    count: int = 0
    limit: Annotated[float, POSITIVE] | None = None

    def checked(self, where):
        if self.count > 3 and not self.lamps:
            raise (where / "count").error(f"got {self.count}", "lamps too")
        return self


def read(tmp_path, text):
    path = tmp_path / "room.toml"
    path.write_text(text)
    return from_table(Room, *read_toml(path))


GOOD = "[main]\npower_W = 5\n"


def test_values_and_defaults(tmp_path):
    room = read(
        tmp_path,
        'origin = [1, 2, 3]\nsize = [4, 5.5]\nlimit = 7\n[main]\npower_W = 5\nnote = "n"\n'
        '[[lamps]]\npower_W = 1\ncolour = "green"\n[named.a]\npower_W = 2\n',
    )
    assert room == Room(
        main=Lamp(5.0, note="n"),
        lamps=(Lamp(1.0, "green"),),
        named={"a": Lamp(2.0)},
        origin=(1.0, 2.0, 3.0),
        size=(4.0, 5.5),
        limit=7.0,
    )
    assert isinstance(room.limit, float)
    assert read(tmp_path, GOOD) == Room(Lamp(5.0))
    assert read(tmp_path, "\ufeff" + GOOD) == Room(Lamp(5.0))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("count = 1", "room.toml: main: missing; expected a table [main]"),
        ("main = 3", ":1: main: got integer 3; expected a table [main]"),
        ("[main]\nnote = 'x'", ":1: main.power_W: missing; expected a positive number"),
        ("[main]\npower_W = -1", ":2: main.power_W: got integer -1; expected a positive"),
        ("[main]\npower_W = true", ":2: main.power_W: got boolean true; expected a positive"),
        (
            "[main]\npower_W = nan",
            ":2: main.power_W: got nan; expected a finite number (a",
        ),
        ("[main]\npower_w = 5", ":2: main.power_w: unknown field (did you mean 'power_W'?); expec"),
        (f"{GOOD}colour = 'blue'", ":3: main.colour: got text 'blue'; expected one of red, green"),
        (f"origin = [1, 2]\n{GOOD}", ':1: origin: got a list [1, 2]; expected 3 numbers or "door"'),
        (f"origin = 'window'\n{GOOD}", ":1: origin: got text 'window'; expected 3 numbers or \"d"),
        (f"size = []\n{GOOD}", ":1: size: got a list []; expected one number or several"),
        (f"size = [1, 'x']\n{GOOD}", ":1: size[1]: got text 'x'; expected a number"),
        (f"limit = 0\n{GOOD}", ":1: limit: got integer 0; expected a positive number"),
        (f"count = 1.5\n{GOOD}", ":1: count: got number 1.5; expected an integer"),
        (
            f"count = 0x{'f' * 5000}\n{GOOD}",
            ":1: count: got integer of 20000 bits; expected an",
        ),
        (f"count = 4\n{GOOD}", ":1: count: got 4; expected lamps too"),
        (f"{GOOD}[[lamps]]\npower_W = 1\n[[lamps]]\npower_W = 0", ":6: lamps[1].power_W: got"),
        (
            f"{GOOD}[named.b]\npower_W = 0",
            ":4: named.b.power_W: got integer 0; expected a positive",
        ),
    ],
)
def test_bad_field_is_one_line_with_its_place(tmp_path, text, expected):
    with pytest.raises(InputError) as error:
        read(tmp_path, text)
    assert expected in str(error.value)


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 100_000,
        "a = " + "{b = " * 50_000,
        "a = " + "9" * 1_000_000,
        "a = 0x" + "f" * 1_000_000,
        "a = " + "[" * 200 + "]" * 200,
        ".".join(["a"] * 100_000) + " = 1",
        "a" * 1_000_000 + " = 1",
        "count = " + " " * 1_000_000 + "'x'",
        "[" + " " * 1_000_000 + "x",
        "[" + "x " * 500_000 + "]\n",
        "'" + "\\" * 1_000_000,
        "\n" * 1_000_000 + "a = 1",
        "x = 1\n" * 200_000,
        "[[lamps]]\npower_W = 0\n" * 20_000,
        "count = [" + "1, " * 300_000 + "]",
        "\0" * 1000,
        "a = 1\n" * (LARGEST_BYTES // 6 + 2),
    ],
    ids=range(17),
)
def test_hostile_files_are_refused_in_bounded_time(tmp_path, text):
    begin = time.process_time()
    with pytest.raises(InputError) as error:
        read(tmp_path, text)
    assert len(str(error.value)) < 1000 + len(str(tmp_path))
    assert time.process_time() - begin < 20


def test_a_table_comes_back_from_its_dataclass(tmp_path):
    room = read(tmp_path, "origin = [1, 2, 3]\n" + GOOD)
    table = to_table(room)
    assert table["origin"] == [1.0, 2.0, 3.0]
    changed = merged(table, {"main": {"note": "new"}})
    assert changed["main"] == {"power_W": 5.0, "colour": "red", "note": "new"}
    assert table["main"]["note"] is None
