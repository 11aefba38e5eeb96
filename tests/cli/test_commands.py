"""The commands as a newcomer types them; and every wrong turn in one line."""

import json
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.text import Text

from surgisoft.cli import MANY, command_line, run, spread
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import load_recording
from tests.few_effects import few_effects


@pytest.fixture(scope="module", autouse=True)
def _few_effects():
    with few_effects("creep", "payload"):
        yield


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A small collection and a model fitted to it."""
    folder = tmp_path_factory.mktemp("lab")
    for protocol, points in (("walk", "1000"), ("validation", "150"), ("test", "150")):
        out = str(folder / f"{protocol}.parquet")
        assert run(["collect", protocol, "--points", points, "--seed", "4", "-o", out]) == 0
    assert (
        run(
            [
                "fit", str(folder / "walk.parquet"), "--valid", str(folder / "validation.parquet"),
                "--effects", "hysteresis", "--prior", "none", "--epochs", "25",
                "--widths", "48,48", "-o", str(folder / "arm"),
            ]
        )
        == 0
    )  # fmt: skip
    return folder


def test_a_simulated_recording_leaves_the_log_of_an_interrupted_one(tmp_path):
    """It wrote none: the log is all that is left of a real recording."""
    left = tmp_path / "bench.log.jsonl"
    left.write_text("what was measured until then")
    out = str(tmp_path / "bench.csv")
    assert run(["collect", "validation", "--points", "10", "-o", out]) == 0
    assert left.read_text() == "what was measured until then"


def test_fitted_arm_beats_pressure_alone(lab, capsys):
    plain = str(lab / "plain")
    assert (
        run(
            [
                "fit", str(lab / "walk.parquet"), "--valid", str(lab / "validation.parquet"),
                "--inputs", "pressure", "--prior", "none", "--epochs", "25",
                "--widths", "48,48", "-o", plain,
            ]
        )
        == 0
    )  # fmt: skip
    errors = {}
    for name in ("arm", "plain"):
        file = lab / f"{name}.json"
        assert (
            run(["compare", str(lab / name), str(lab / "test.parquet"), "--json", str(file)]) == 0
        )
        errors[name] = json.loads(file.read_text())
    effects = {
        name: list(json.loads((lab / name / "config.json").read_text())["effects"])
        for name in ("arm", "plain")
    }
    assert effects == {"arm": ["hysteresis"], "plain": []}
    assert errors["arm"]["rmse_mm"] < 0.7 * errors["plain"]["rmse_mm"]
    assert errors["arm"]["floor_mm"] < errors["arm"]["rmse_mm"]
    assert errors["arm"]["samples"] == 150
    assert len(errors["arm"]["per_key_point_mm"]) == 5
    out = capsys.readouterr().out
    assert f"RMSE {errors['arm']['rmse_mm']:.4f} mm" in out


def test_a_folder_holds_config_weights_and_report(lab):
    report = json.loads((lab / "arm" / "report.json").read_text())
    assert [stage["name"] for stage in report["stages"]][:2] == ["pressure", "hysteresis"]
    assert (lab / "arm" / "weights.safetensors").is_file()
    assert json.loads((lab / "arm" / "config.json").read_text())["arm"]["unit"] == "kPa"


RESULTS = {
    "compare {arm} {rec}": "rmse_mm",
    "diagnose {arm} {rec}": "verdict",
    "amend {arm} --effect payload --data {rec} -o {new}": "error_mm",
    "improve {arm} {rec} -o {new}": "rounds",
}
"""Commands with `--json`, and a key of their results."""


@pytest.mark.parametrize("command", RESULTS)
def test_only_an_older_result_of_the_same_command_is_replaced(lab, tmp_path, capsys, command):
    """All of them look before they read a model: that there is none is the error where they may."""
    arm, rec, new = tmp_path / "none", lab / "test.parquet", tmp_path / "new"
    asked = command.format(arm=arm, rec=rec, new=new).split()
    file = tmp_path / "result.json"
    others = [key for key in RESULTS.values() if key != RESULTS[command]]
    for content, message in (
        ("mine", "exists already and is not an older result"),
        (json.dumps({others[0]: 1, others[1]: 2, others[2]: 3}), "is not an older result"),
        (json.dumps({RESULTS[command]: {}}), "no arm model there"),
    ):
        file.write_text(content)
        assert run([*asked, "--json", str(file), "--report", str(tmp_path)]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
        assert file.read_text() == content


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fit", "{lab}/walk.parquet", "-o", "{lab}/arm"], "already exists"),
        (["fit", "{lab}/nothing.parquet", "-o", "{lab}/new"], "nothing.parquet"),
        (["fit", "{lab}/walk.parquet", "-o", "{lab}/new", "--effects", "ghost"], "known are"),
        (["fit", "{lab}/walk.parquet", "-o", "{lab}/new", "--widths", "a,b"], "whole numbers"),
        (["fit", "{lab}/walk.parquet", "-o", "{lab}/new", "--inputs", "smell"], "'smell'"),
        (["fit"], "Missing argument"),
        (["compare", "{lab}", "{lab}/test.parquet"], "no arm model there"),
        (["compare", "{lab}/arm", "{lab}/arm/config.json"], "config.json"),
        (
            ["compare", "{lab}/arm", "{lab}/test.parquet", "--json", "{lab}/test.parquet"],
            "not an older result",
        ),
        (
            ["compare", "{lab}/arm", "{lab}/test.parquet", "--json", "{lab}/arm/config.json"],
            "not an older result",
        ),
        (
            ["compare", "{lab}/arm", "{lab}/test.parquet", "--report", "{lab}/test.parquet/x"],
            "not a writable folder",
        ),
        (["fit", "{lab}/walk.parquet", "-o", "{lab}/walk.parquet/x"], "not a writable folder"),
        (
            ["fit", "--valid", "{lab}/test.parquet", "{lab}/walk.parquet", "-o", "x"],
            "belong to that option",
        ),
        (["collect", "dance", "-o", "{lab}/x.parquet"], "dance"),
        (["collect", "walk", "-o", "{lab}/x.parquet", "--hidden", "ghost"], "ghost"),
        (["fti"], "No such command"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(lab, capsys, arguments, message):
    before = sorted(path.name for path in lab.iterdir())
    assert run([argument.format(lab=lab) for argument in arguments]) == 2
    err = [line for line in capsys.readouterr().err.splitlines() if "warning" not in line]
    assert len(err) == 1
    assert err[0].startswith("surgisoft: error: ")
    assert message in err[0]
    assert sorted(path.name for path in lab.iterdir()) == before


def test_version_and_help_leave_with_zero(capsys):
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.startswith("surgisoft 0.")
    assert run(["fit", "--help"]) == 0
    assert "--valid" in capsys.readouterr().out


def test_options_of_many_values_are_spread():
    assert spread(["fit", "a", "--valid", "b", "c", "-o", "m", "d"]) == [
        "fit", "a", "--valid", "b", "--valid", "c", "-o", "m", "d",
    ]  # fmt: skip
    assert spread(["--hidden", "creep", "--strength", "-1.5"]) == [
        "--hidden", "creep", "--strength", "-1.5",
    ]  # fmt: skip


def _options():
    """(command, option) of every command but the long studies."""

    def walk(path, command):
        if hasattr(command, "commands"):
            for name, inner in command.commands.items():
                yield from walk((*path, name), inner)
        else:
            for option in command.params:
                if option.opts[0].startswith("-"):
                    yield " ".join(path), option

    return [pair for pair in walk((), command_line()) if not pair[0].startswith("benchmark")]


def _helps(path, command):
    """(words, help text) of a command, its arguments and options, and every command in it."""
    yield " ".join(path), command.help or ""
    for each in command.params:
        yield " ".join((*path, each.name)), getattr(each, "help", None) or ""
    for name, inner in getattr(command, "commands", {}).items():
        yield from _helps((*path, name), inner)


def test_one_name_means_one_thing_in_every_command():
    told = {}
    for command, option in _options():
        kind = (option.metavar, option.multiple, "-o" in option.opts)
        if "--output" in option.opts:
            assert kind == (option.metavar or "a metavar", False, True), command
            continue
        # A file or a run here, a choice there.
        for name in set(option.opts) - {"--map", "--resume"}:
            assert told.setdefault(name, kind) == kind, f"{name} of {command}"


def test_collect_accepts_the_model_behind_preflight_as_before(tmp_path):
    """A folder or `default` behind the switch is the arm model, a protocol's name is not."""
    new = ["collect", "walk", "--preflight", "--arm", "default"]
    assert spread(["collect", "walk", "--preflight", "default"]) == new
    assert spread(["collect", "walk", "--preflight=default"]) == new
    folder = str(tmp_path)
    assert spread(["collect", "--preflight", folder, "walk"])[1:4] == [
        "--preflight",
        "--arm",
        folder,
    ]
    for other in (["collect", "--preflight", "walk"], ["evaluate", "--preflight", "default"]):
        assert spread(other) == other


def test_every_option_of_many_values_shows_it_in_the_help():
    several = [(command, option) for command, option in _options() if option.multiple]
    assert {name for _, option in several for name in option.opts} == MANY
    for command, option in several:
        assert option.metavar.endswith("..."), f"{option.opts} of {command}"


def test_no_part_of_a_help_text_is_taken_for_markup():
    """Of `[measured]` nothing would be printed."""
    texts = dict(_helps((), command_line()))
    assert "delay_s" in texts["import delay_s"]
    assert {name: Text.from_markup(text).plain for name, text in texts.items()} == texts


def test_python_runs_the_package_as_the_command(capsys):
    """`python -m surgisoft`, as torchrun starts it."""
    command = [sys.executable, "-m", "surgisoft", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert run(["--version"]) == 0
    assert done.stdout == capsys.readouterr().out


def test_old_names_of_options_still_work_and_are_not_shown(tmp_path, capsys):
    old = ["collect", "walk", "--points", "12", "--specimen", "3", "--take=2"]
    new = ["collect", "walk", "--points", "12", "--robot-seed", "3", "--trial", "2"]
    for name, arguments in (("old", old), ("new", new)):
        assert run([*arguments, "-o", str(tmp_path / f"{name}.csv")]) == 0
    one, other = ((tmp_path / f"{name}.csv").read_bytes() for name in ("old", "new"))
    assert one == other
    wrong = ["evaluate", "scripted", "--task", "track_circle", "--trust", "0.5"]
    assert run(wrong) == 2
    assert "--observer-gain" in capsys.readouterr().err
    shown = {name for _, option in _options() for name in option.opts}
    assert {"--robot-seed", "--trial", "--observer-gain"} <= shown
    assert not {"--specimen", "--take", "--trust", "--referee"} & shown
    assert spread(["evaluate", "scripted", "--no-referee"])[-1] == "--no-exact-checks"
    # A study has options of its own.
    assert spread(["benchmark", "x", "--specimen", "1"])[2] == "--specimen"


BEFORE_PYTORCH = [
    "compare nowhere x.csv",
    "compare default x.csv",
    "diagnose default x.csv",
    "improve default x.csv -o new",
    "amend default --effect creep --data x.csv -o new",
    "next-experiment nowhere",
    "fit x.csv -o new",
    "scene new nope.stl -o new",
]
"""Commands with a file that is not there."""


def test_a_missing_file_is_reported_before_pytorch_is_loaded(tmp_path):
    """One program runs the commands, one after another."""
    code = (
        "import sys; from surgisoft.cli import run\n"
        "for command in sys.argv[1:]:\n"
        "    print(command, run(command.split()), 'torch' in sys.modules, sep=': ')"
    )
    words = [sys.executable, "-c", code, *BEFORE_PYTORCH]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout.splitlines() == [f"{each}: 2: False" for each in BEFORE_PYTORCH], done.stderr


def test_a_table_without_orientations_needs_no_rotations_of_scipy(tmp_path):
    """Its import takes 0.3 s, a tenth of what a table of a million rows takes."""
    (tmp_path / "raw.csv").write_text("t,p,x,y,z\n0,0,0,0,90\n0.1,5,1,0,90\n0.2,9,2,0,90\n")
    (tmp_path / "map.toml").write_text(
        '[time]\ncolumn = "t"\nunit = "s"\n[measured]\ncolumns = ["p"]\nunit = "kPa"\n'
        '[key_points]\npositions = [["x", "y", "z"]]\nunit = "mm"\n'
    )
    code = (
        "import sys; from surgisoft.cli import run;"
        "code = run('import raw.csv --map map.toml -o out.csv'.split());"
        "print(code, 'scipy.spatial' in sys.modules, 'torch' in sys.modules)"
    )
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout.split()[-3:] == ["0", "False", "False"], done.stderr


def test_files_are_written_before_the_output_is_printed(lab, tmp_path, monkeypatch):
    """A closed pipe, as `| head` leaves it, loses no file."""

    plain = print

    def closed(*words, file=None, **more):
        if file in (None, sys.stdout):
            raise BrokenPipeError
        plain(*words, file=file, **more)  # as numba does where it compiles

    monkeypatch.setattr("builtins.print", closed)
    monkeypatch.setattr("os.dup2", lambda *_: None)
    files = [tmp_path / name for name in ("a.json", "page", "a.rrd")]
    options = zip(("--json", "--report", "--replay"), map(str, files), strict=True)
    arguments = ["compare", str(lab / "arm"), str(lab / "test.parquet")]
    assert run([*arguments, *(word for pair in options for word in pair)]) == 0
    assert all(path.exists() for path in files)


def test_several_models_on_the_same_recording(lab, tmp_path, monkeypatch, capsys):
    """The table, the page and the numbers hold each of them; models stand before recordings.

    The pages of single models are without their charts here, which tests/diagnosis/test_compare.py
    has.
    """
    pages = "surgisoft.diagnosis.pages.compare"
    for drawing in ("draw_all", "axis_charts"):
        monkeypatch.setattr(f"{pages}.{drawing}", lambda *_: [])
    arm, test, file = str(lab / "arm"), str(lab / "test.parquet"), tmp_path / "c.json"
    options = ["--json", str(file), "--report", str(tmp_path / "page")]
    assert run(["compare", arm, "default", test, *options]) == 0
    out = capsys.readouterr().out
    said = f"surgisoft diagnose {lab / 'arm'} {lab / 'test.parquet'}" in out
    assert said == bool(json.loads(file.read_text())["explainable"])
    values = json.loads(file.read_text())
    assert [each["model"] for each in values["models"]] == ["arm", "default"]
    assert values["models"][0]["rmse_mm"] == values["rmse_mm"]
    assert values["models"][1]["rmse_mm"] != values["rmse_mm"]
    assert f"default  {values['models'][1]['rmse_mm']:10.4f}" in out
    page = (tmp_path / "page" / "report.html").read_text()
    assert "1/report.html" in page
    assert "Model arm has the smallest error" in page
    assert (tmp_path / "page" / "2" / "report.html").is_file()
    for wrong, said in (
        (["compare", arm, test, "default"], "give all models first"),
        (["compare", arm, "default"], "models only"),
        (["compare", arm, test, "--error-scale", "1"], "add --replay"),
    ):
        assert run(wrong) == 2
        assert said in capsys.readouterr().err


def test_packaged_names_work_anywhere(tmp_path, monkeypatch, capsys):
    """As after `pip install`: no folder of the repository is here."""
    monkeypatch.chdir(tmp_path)
    assert run(["experiment", "check", "liver"]) == 0
    assert "2 settings, 32 episodes" in capsys.readouterr().out
    assert run(["experiment", "list", "phantom_liver"]) == 0
    listed = capsys.readouterr().out
    assert run(["experiment", "list"]) == 0
    assert capsys.readouterr().out == listed
    assert run(["scene", "show", "phantom_liver", "--save", "x.rrd"]) == 0


def test_next_experiment_records_on_a_simulated_rig_and_asks_a_person_at_a_real_one(
    tmp_path, monkeypatch, capsys
):
    from surgisoft.diagnosis.design import next_experiment as designing
    from surgisoft.diagnosis.design.next_experiment import Pair, Recommendation
    from surgisoft.measurement.protocols import Protocol

    schedule = Protocol(
        "s", "continuous", np.tile([5.0, 10.0, 15.0], (4, 1)), np.zeros(4), np.arange(4.0)
    )
    found = Recommendation(
        "roll_90: ramps",
        schedule,
        "roll_90",
        1.0,
        (Pair(("payload", "drift"), 0.5, 0.9),),
        ("turn the base",),
        {"roll_deg": 90.0},
        None,
    )
    monkeypatch.setattr(designing, "next_experiment", lambda *_, **__: found)
    plan, new = tmp_path / "s.csv", tmp_path / "new.parquet"
    command = ["next-experiment", "default", "-o", str(plan), "--force", "--record", str(new)]
    assert run([*command, "--rig", "tests.rig.own_rig:OwnRig:port=x"]) == 2
    assert "is not: first turn the base; then 'surgisoft collect" in capsys.readouterr().err
    assert plan.exists()
    assert not new.exists()
    assert run([*command, "--rig", "virtual:seed=3"]) == 0
    recording = load_recording(new)
    assert recording.gravity == pytest.approx([0.0, -0.42, 0.9075], abs=1e-3), "rolled by 90 deg"
    said = capsys.readouterr().out
    assert f"then: surgisoft diagnose default {new}" in said, "the file that was just recorded"
    assert "surgisoft collect" not in said, "it is done"
    assert run([*command[:-2], "--rig", "tests.rig.own_rig:OwnRig:port=x"]) == 0
    said = capsys.readouterr().out
    assert f"on the rig: surgisoft collect {plan} --rig tests.rig.own_rig:OwnRig:port=x" in said
    assert "virtual" not in said
    for path in (plan, new):
        path.unlink()
    for rig, error in (("nothere", "unknown rig 'nothere'"), ("serial:prt=x", "option 'prt'")):
        assert run([*command, "--rig", rig]) == 2
        assert error in capsys.readouterr().err
        assert not plan.exists(), "a rig that cannot be is refused before the search"
    plain = replace(found, rig_options={})
    monkeypatch.setattr(designing, "next_experiment", lambda *_, **__: plain)
    assert run([*command, "--rig", f"serial:port={tmp_path / 'none'},mocap=udp:9763"]) == 2
    error = capsys.readouterr().err
    assert "cannot be opened" in error
    assert f"is written; to record it: 'surgisoft collect {plan} --rig serial" in error
    assert plan.exists()


def test_time_on_the_bench_where_the_clock_begins_anew_with_each_run():
    from surgisoft.cli.collect import written_line

    def line(t_s):
        recording = SimpleNamespace(
            t_s=np.array(t_s), noise_mm=None, samples=len(t_s), kind="continuous", chambers=3,
            key_points=5, runs=[0, 1],
        )  # fmt: skip
        return written_line(Path("a.parquet"), recording)

    assert "2 runs, 50 s on the bench" in line([0.0, 20.0, 0.0, 30.0])
    assert "2 runs, 4 min on the bench" in line([10.0, 100.0, 130.0, 240.0])


def test_many_pictures_are_one_line(tmp_path, capsys):
    from surgisoft.cli.files import show_written

    few = [tmp_path / "a.png", tmp_path / "b.png"]
    many = [tmp_path / "pictures" / f"{k}.svg" for k in range(5)]
    show_written([*many, tmp_path / "report.html", *few])
    assert capsys.readouterr().out.splitlines() == [
        f"wrote {tmp_path / 'report.html'}: open it in a browser",
        f"wrote {few[0]}",
        f"wrote {few[1]}",
        f"wrote 5 pictures to {tmp_path / 'pictures'}",
    ]


def test_a_run_too_short_for_its_detector_names_the_option(tmp_path, capsys):
    command = f"run mixed -o {tmp_path / 'run.parquet'} --clean 20 --clock simulated"
    assert run(command.split()) == 2
    assert "--clean 20: expected at least" in capsys.readouterr().err


def test_an_interrupted_experiment_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    from surgisoft.experiments import session

    def interrupted(*_):
        raise KeyboardInterrupt

    started = SimpleNamespace(name="liver"), tmp_path
    monkeypatch.setattr(session, "start_experiment", lambda *_, **__: started)
    monkeypatch.setattr(session, "finish_experiment", interrupted)
    assert run(["experiment", "run", "liver"]) == 130
    plain = f"continue with: surgisoft experiment run liver -o {tmp_path} --resume"
    assert capsys.readouterr().out.rstrip().endswith(plain)
    given = "--policy ring runs/a --repeats 2 --rig 'laser=x endoscope=y' --preflight"
    for where in ("--processes 2", "--cluster tcp://a:1"):
        options = f"{given} {where} --no-replays"
        assert run(["experiment", "run", "liver", *shlex.split(options)]) == 130
        assert capsys.readouterr().out.rstrip().endswith(f"{plain} {options}")


def test_a_command_leaves_the_function_of_commands_in_place(capsys):
    """No module of a command has the name of a function of `surgisoft.cli`."""
    import surgisoft.cli

    assert surgisoft.cli.run(["recording", "nowhere.parquet"]) == 2
    assert surgisoft.cli.run(["recording", "nowhere.parquet"]) == 2
    assert capsys.readouterr().err.count("nowhere.parquet") >= 2


def test_a_recording_that_is_there_is_refused_before_the_rig_moves(tmp_path, monkeypatch, capsys):
    def moved(*_, **__):
        raise AssertionError("the rig was driven")

    monkeypatch.setattr("surgisoft.rig.trial.collect", moved)
    there = tmp_path / "r.csv"
    there.write_text("x")
    assert run(["collect", "holds", "-o", str(there)]) == 2
    assert f"{there}: exists already" in capsys.readouterr().err
    assert there.read_text() == "x"


@pytest.mark.parametrize(
    ("option", "told"),
    [
        ("--steps 1e5", "--steps is '1e5', expected a whole number, such as 100000"),
        ("--steps 2.5", "--steps is '2.5', expected a whole number"),
        ("--steps 1e999", "--steps is '1e999', expected a whole number"),
        ("--minutes x", "--minutes is 'x', expected a number"),
        ("--seed -1", "--seed is '-1', expected 0 or more"),
        ("--threads 1000", "--threads is '1000', expected 256 or less"),
        ("--minutes", "Option '--minutes' requires an argument"),
        ("--nothing 1", "No such option: --nothing"),
    ],
)
def test_a_wrong_value_of_an_option_is_told_with_what_is_expected(option, told, capsys):
    assert run(["train", *option.split()]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"surgisoft: error: {told}; see 'surgisoft")
    assert error.count("\n") == 1


def test_each_hidden_effect_has_its_own_strength(tmp_path, monkeypatch):
    asked = {}

    def noted(*_, **given):
        asked.update(given)
        raise InputError("asked")

    monkeypatch.setattr("surgisoft.rig.trial.collect", noted)
    line = ["collect", "holds", "-o", str(tmp_path / "r.csv"), "--hidden", "payload", "creep@20"]
    assert run([*line, "--strength", "0.5", "2", "--seed", "3", "--trial", "4"]) == 2
    assert [tuple(each) for each in asked["hidden"]] == [("payload", 0.5), ("creep", 2.0, 20.0)]
    assert (asked["seed"], asked["trial"]) == (3, 4)
