"""Rigs by name: options, other packages, user-defined objects, and one line for what is wrong."""

import sys
from pathlib import Path

import numpy as np
import pytest

import surgisoft
from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.measurement.protocols import load_schedule
from surgisoft.measurement.recordings import load_recording
from surgisoft.rig import SafeRig, VirtualRig, open_rig
from surgisoft.rig.interface import close, is_simulated, vent
from surgisoft.rig.registry import (
    RIGS,
    SIMULATED,
    RigText,
    check_rig,
    parse_rig,
    rig_names,
    rig_options,
)
from tests.rig.own_rig import OwnRig

OWN = "tests.rig.own_rig:OwnRig"


def test_options_reach_the_rig_with_their_types():
    rig = open_rig("virtual:seed=3,hidden=creep:0.5/leak,gravity=0/0/1,payload_g=2,noise=0")
    assert isinstance(rig, VirtualRig)
    assert (rig.config.seed, rig.config.hidden) == (3, (("creep", 0.5), ("leak", 1.0)))
    assert (rig.config.gravity, rig.payload_g, rig.config.noise) == ((0.0, 0.0, 1.0), 2.0, 0.0)


def test_every_option_of_the_simulated_rig_reaches_it():
    """Hidden effects as text and as tuples, of which one begins after 60 s."""
    text = "virtual:seed=2,noise_seed=7,roll_deg=30,rate_Hz=25,hidden=creep:0.5/payload:2@60"
    config = open_rig(text).config
    assert (config.seed, config.take, config.roll_deg, config.cameras.rate_Hz) == (2, 7, 30.0, 25.0)
    assert (config.hidden, config.later) == ((("creep", 0.5),), (("payload", 2.0, 60.0),))
    given = open_rig("virtual", hidden=(("creep", 0.5), ("payload", 2.0, 60.0))).config
    assert (given.hidden, given.later) == (config.hidden, config.later)


def test_an_object_of_a_users_module_is_opened_with_its_parameters():
    rig = open_rig(f"{OWN}:port=/dev/ttyUSB0,rate_hz=10")
    assert isinstance(rig, SafeRig), "nothing real is driven without it"
    assert (rig.rig.port, rig.period_s) == ("/dev/ttyUSB0", 0.1)
    assert not is_simulated(rig)
    assert is_simulated(open_rig("virtual"))


def test_a_module_of_the_working_folder_is_found(tmp_path, monkeypatch):
    (tmp_path / "bench_of_mine.py").write_text(
        "from surgisoft.rig import VirtualRig\ndef make(robot: int = 0):\n"
        "    return VirtualRig(robot)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    assert open_rig("bench_of_mine:make:robot=4").config.seed == 4
    with pytest.raises(InputError, match="'highest' is a safety limit of real rigs, and this one"):
        open_rig("bench_of_mine:make:robot=4,highest=20")


def test_a_rig_of_another_package(tmp_path, monkeypatch):
    info = tmp_path / "lab_bench-1.0.dist-info"
    info.mkdir()
    (tmp_path / "lab_bench.py").write_text("from tests.rig.own_rig import OwnRig as Bench\nX = 1\n")
    (info / "METADATA").write_text("Name: lab_bench\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[surgisoft.rigs]\nlab = lab_bench:Bench\nabsent = lab_bench_absent:Bench\n"
        "number = lab_bench:X\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert rig_names()[-3:] == ["lab", "absent", "number"]
    assert open_rig("lab:port=COM3").rig.port == "COM3"
    with pytest.raises(InputError, match=r"rig 'absent'.*does not load.*No module named"):
        open_rig("absent")
    with pytest.raises(InputError, match="rig 'number': is a int; expected a class or a function"):
        open_rig("number")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("virtul", "unknown rig 'virtul': known are elastica, "),
        ("virtual:sed=3", "unknown option 'sed'; its options: seed, noise_seed, hidden"),
        ("virtual:seed=3.5", "option 'seed' is '3.5', expected a whole number"),
        ("virtual:noise=nan", "option 'noise' is 'nan', expected a finite number"),
        (
            "virtual:gravity=0/1",
            "option 'gravity' is '0/1', expected 3 of numbers separated by '/'",
        ),
        (
            "virtual:gravity=0/0/1/0",
            "option 'gravity' is '0/0/1/0', expected 3 of numbers separated by '/'",
        ),
        ("virtual:seed=1,seed=2", "option 'seed' is given twice"),
        ("virtual:seed", "got 'seed', expected option=value after 'virtual:'"),
        ("virtual:seed=1,noise", "got 'noise', expected option=value after 'virtual:'"),
        ("virtual:seed=-1", "seed is -1, expected a whole number >= 0"),
        ("virtual:hidden=crep", "crep"),
        (f"{OWN}", "option 'port' is missing; expected tests.rig.own_rig:OwnRig:port=..."),
        ("tests.rig.own_rig:Nothing", "'tests.rig.own_rig' has no 'Nothing'"),
        ("no_such_module:Rig", "module 'no_such_module' does not load"),
        (f"{OWN}:port=x,rate=-1", "rate is -1.0, expected 0 or a number above 0"),
        (f"{OWN}:port=x,highest=-2", "leave nothing of the rig's limits 0 to 40 kPa"),
        (f"{OWN}:port=x,hold_ms=9e9", "expected 0 < hold_ms <= vent_ms"),
        ("virtual:highest=20", "unknown option 'highest'"),
        ("/dev/ttyACM0", r"expected NAME\[:option=value"),
    ],
)
def test_a_text_that_names_no_rig_is_one_line(text, message, tmp_path, capsys):
    with pytest.raises(InputError, match=message):
        open_rig(text)
    out = tmp_path / "r.parquet"
    assert run(["collect", "walk", "--rig", text, "-o", str(out)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not out.exists()


def test_an_option_beside_the_text_counts_once():
    assert parse_rig("virtual:seed=3").options == {"seed": "3"}
    assert open_rig("virtual:seed=3", {"seed": 5}).config.seed == 3
    assert open_rig("virtual", {"seed": 5, "port": "x"}).config.seed == 5
    with pytest.raises(InputError, match="option 'seed' is 3 in the rig's text and 5 beside it"):
        open_rig("virtual:seed=3", seed=5)


@pytest.mark.parametrize("name", list(RIGS))
def test_every_option_is_explained(name, capsys):
    assert all(option.about for option in rig_options(name).values())
    assert run(["rig", "list", name]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"{name}: ")
    shown = [line.split()[0] for line in out.splitlines()[1:] if line.startswith("  ")]
    assert shown[: len(rig_options(name))] == list(rig_options(name))
    assert ("hold_ms" in shown) == (name not in SIMULATED)


def test_the_seed_in_the_text_is_the_seed_of_collect(tmp_path):
    a, b = tmp_path / "a.parquet", tmp_path / "b.parquet"
    walk = ["collect", "walk", "--points", "24"]
    assert run([*walk, "--rig", "virtual:seed=3,hidden=creep", "-o", str(a)]) == 0
    assert run([*walk, "--seed", "3", "--hidden", "creep", "-o", str(b)]) == 0
    one, other = load_recording(a), load_recording(b)
    np.testing.assert_array_equal(one.key_points_mm, other.key_points_mm)
    np.testing.assert_array_equal(one.commanded, other.commanded)


def test_a_schedule_gives_the_same_recording_wherever_it_lies(tmp_path, monkeypatch):
    rows = "t_s,c1_kPa,c2_kPa,c3_kPa\n0,0,0,0\n1,20,5,0\n2,5,30,10\n"
    (tmp_path / "there").mkdir()
    (tmp_path / "a.csv").write_text(rows)
    (tmp_path / "there" / "b.csv").write_text(rows)
    first = surgisoft.collect(tmp_path / "a.csv")
    monkeypatch.chdir(tmp_path / "there")
    for given in ("b.csv", Path("../a.csv"), load_schedule("b.csv")):
        again = surgisoft.collect(given)
        np.testing.assert_array_equal(again.key_points_mm, first.key_points_mm)
    noise = [surgisoft.collect("b.csv", trial=1).measured - first.measured]
    Path("c.csv").write_text(rows.replace("5,30,10", "5,30,10.5"))
    noise.append((surgisoft.collect("c.csv").measured - first.measured)[:10])
    assert all(np.abs(each).max() > 0 for each in noise), "other trials and schedules, other noise"


def test_collect_drives_a_users_rig_and_refuses_what_it_has_no_option_for(tmp_path, capsys):
    out = tmp_path / "r.parquet"
    walk = ["collect", "walk", "--points", "24", "--rig", f"{OWN}:port=x", "-o", str(out)]
    assert run([*walk, "--hidden", "creep"]) == 2
    assert "unknown option 'hidden'; its options: port, robot" in capsys.readouterr().err
    assert run(walk) == 0
    recording = load_recording(out)
    assert recording.samples == 24
    assert recording.commanded.min() >= 0.0
    assert recording.commanded.max() <= 40.0
    same = surgisoft.collect("walk", f"{OWN}:port=x", points=24)
    np.testing.assert_array_equal(same.measured, recording.measured)


BENCH = """
from bench_part import STEP
from tests.rig.own_rig import OwnRig

class Bench(OwnRig):
    def __init__(self, robot: int = STEP):
        super().__init__("x", robot)
"""


def test_a_rig_is_named_by_its_file_as_a_model_is(tmp_path, monkeypatch, capsys):
    """The file's own folder counts for its imports; changed content is read again."""
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "bench_part.py").write_text("STEP = 4")
    file = tmp_path / "lab" / "bench.py"
    file.write_text(BENCH)
    name = f"{file}:Bench"
    assert parse_rig(f"{name}:robot=2") == RigText(name, {"robot": "2"})
    assert rig_options(name)["robot"].default == 4
    file.write_text(BENCH.replace("= STEP", "= 5"))
    assert rig_options(name)["robot"].default == 5
    of_file = surgisoft.collect("walk", f"{name}:robot=0", points=24)
    of_module = surgisoft.collect("walk", f"{OWN}:port=x", points=24)
    np.testing.assert_array_equal(of_file.measured, of_module.measured)
    monkeypatch.chdir(tmp_path / "lab")
    assert run(["rig", "list", "bench.py:Bench"]) == 0
    assert capsys.readouterr().out.startswith("bench.py:Bench: ")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bench.py", "expected FILE.py:object, such as bench.py:Bench"),
        ("bench.py:seed=3", "expected FILE.py:object, such as bench.py:Bench"),
        ("away.py:Bench", "no file away.py; expected FILE.py:object"),
        ("bench.py:Bank", "'bench.py' has no 'Bank'; correct the name"),
        (
            "broken.py:Bench",
            r"file 'broken.py' does not load \(ZeroDivisionError in broken.py line \d+: ",
        ),
        ("exits.py:Bench", r"file 'exits.py' does not load \(SystemExit in exits.py line \d+: 3"),
    ],
)
def test_a_file_that_holds_no_rig_is_one_line(text, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("bench.py").write_text("class Bench: pass")
    Path("broken.py").write_text("1 / 0")
    Path("exits.py").write_text("raise SystemExit(3)")
    with pytest.raises(InputError, match=message):
        check_rig(text)


def test_list_shows_a_rig_with_the_options_of_its_text(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("sim.py").write_text(
        "class Sim:\n    'An arm of ours.'\n"
        "    def __init__(self, seed: int = 7, noise_mm: float = 0.1): pass\n"
        "    def read_beside_truth(self): pass\n"
    )
    options = [
        "  seed          a whole number, default 7",
        "  noise_mm      a finite number, default",
    ]
    assert run(["rig", "list", "sim.py:Sim"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "sim.py:Sim: An arm of ours.",
        options[0],
        f"{options[1]} 0.1",
    ]
    assert run(["rig", "list", "sim.py:Sim:seed=3"]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == [
        f"{options[0]}, given 3",
        f"{options[1]} 0.1",
    ]
    assert run(["rig", "list", f"{OWN}:port=x,highest=20"]) == 0
    shown = capsys.readouterr().out
    assert "required, given x" in shown
    assert "default inf, given 20" in shown
    assert run(["rig", "list", "sim.py:Sim:sed=3"]) == 2
    assert "unknown option 'sed'; its options: seed, noise_mm" in capsys.readouterr().err


RAISING = """
from tests.rig.own_rig import OwnRig

class Closed(OwnRig):
    def __init__(self):
        raise ConnectionError("no valve box")

class Silent(OwnRig):
    def __init__(self):
        super().__init__("x")

    def read(self):
        raise TimeoutError("the camera is silent")
"""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "Closed",
            "rig 'raising.py:Closed': raised ConnectionError in raising.py line 6: no valve",
        ),
        ("Silent", "raised TimeoutError in raising.py line 13: the camera is silent; correct"),
    ],
)
def test_an_own_rig_that_raises_is_one_line(name, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("raising.py").write_text(RAISING)
    assert run(["collect", "walk", "--rig", f"raising.py:{name}", "-o", "r.parquet"]) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not Path("r.parquet").exists()


def test_venting_uses_what_the_rig_has():
    rig = OwnRig("x")
    close(rig)
    assert (rig.vents, rig.closes) == (1, 1)
    plain = VirtualRig(0)
    plain.command([20.0, 0.0, 5.0])
    vent(plain)
    assert plain.read().commanded.tolist() == [0.0, 0.0, 0.0]


def test_what_is_documented_of_rigs_by_name_is_there():
    text = Path("docs/rigs.md").read_text()
    for name in RIGS:
        assert f"`{name}`" in text
