"""Files of experiments: what is shipped loads, what is wrong is one line with its place."""

import dataclasses
import re
from dataclasses import replace
from pathlib import Path

import pytest

from surgisoft.cli import run
from surgisoft.config import Where, read_toml
from surgisoft.errors import InputError
from surgisoft.experiments.plan import configured, rig_config, settings
from surgisoft.experiments.session import ExperimentRules, find_experiment, with_rigs
from surgisoft.experiments.spec import load_experiment, save_experiment
from surgisoft.scene.spec import PHANTOM
from tests.experiments.tiny import BREATHING, FAULT, TINY, write

SHIPPED = sorted((PHANTOM / "experiments").glob("*.toml"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_experiments_load_and_their_exact_configuration_is_the_same(path, tmp_path):
    spec = load_experiment(path)
    assert spec.name == path.stem
    assert settings(spec)
    save_experiment(spec, tmp_path / "experiment.toml")
    assert load_experiment(tmp_path / "experiment.toml") == spec


def test_the_experiment_of_the_paper_has_its_values():
    spec = load_experiment(PHANTOM / "experiments" / "liver.toml")
    assert spec.limits.time_s == 60.0
    assert [case.plant for case in spec.cases] == ["simulation", "rig"]


BAD = {
    'until = "centred"': ('until = "centered"', "phases[0].until", "one of centred"),
    "seed = 3": ("sead = 3", "sead", "did you mean 'seed'"),
    "repeats = 3": ("repeats = 0", "repeats", "whole number from 1"),
    "timeout_s = 0.3": ('timeout_s = "long"', "phases[0].timeout_s", "a time above 0 s"),
    "fire_mm = 50.0": ("fire_mn = 50.0", "task.fire_mn", "did you mean 'fire_mm'"),
    'laser = "policy"': ('laser = "pilot"', "phases[1].laser", "one of hold, rest"),
    'name = "cut"': ('name = "look"', "phases[1].name", "names that differ"),
    'scene = "{scene}"': ('scene = "nowhere"', "scene", "a scene's folder"),
    "beam = true": (
        'lazer = "rest"',
        "phases[1].lazer",
        "an arm (laser, endoscope) or one of name",
    ),
    'until = "cut"': ('arms = "policy"', "phases[1].arms", "an arm (laser, endoscope) or one of"),
    "timeout_s = 30.0": ("timeout_s = 3.0\nhold_s = 4.0", "phases[1].hold_s", "at most timeout_s"),
    'endoscope = "policy"\nbeam = true': (
        'endoscope = "policy"\nbeam = true\nwithin = 2.0',
        "phases[1].within",
        "at most 1: this share of the ring is cut",
    ),
    '"look"': ('"time"', "phases[0].name", "'time_s' is a column of the results"),
    "time_s = 0.5": ('time_s = 0.5\nretreat = "out"', "limits.retreat", "one of the phases"),
}


@pytest.mark.parametrize(("old", "new", "field", "expected"), [(k, *v) for k, v in BAD.items()])
def test_a_bad_field_is_named_with_its_line(old, new, field, expected, tmp_path, capsys):
    text = TINY.replace(old, new, 1)
    line = 1 + text[: text.rindex(new.splitlines()[-1])].count("\n")
    path = write(tmp_path, text)
    assert run(["experiment", "check", str(path)]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"surgisoft: error: {path}:{line}: {field}: ")
    assert expected in told
    assert told.count("\n") == 1


VARY = '[[vary]]\nfield = "{field}"\nvalues = [{values}]\n'


@pytest.mark.parametrize(
    ("field", "values", "place"),
    [
        ("task.fire_mm", "1.0, -1.0", "vary[0].values[1]"),
        ("task.fire_mn", "1.0", "vary[0].values[0]"),
        ("task.fire_mm", "1.0, [1.0, 2.0]", "vary[0].values[1]"),
        ("hidden.grep", "1.0", "vary[0].field"),
        ("fault.chamber", "1", "vary[0].field"),
        ("mount", "1.0", "vary[0].field"),
        ("rig.robot_seed", "0.5", "vary[0].values"),
    ],
)
def test_what_cannot_vary_is_named(field, values, place, tmp_path):
    path = write(tmp_path, TINY + VARY.format(field=field, values=values))
    with pytest.raises(InputError, match=r"tiny\.toml:\d+: " + place.replace("[", r"\[")):
        settings(load_experiment(path), read_toml(path)[1])


def test_what_varies_makes_a_grid(tmp_path):
    text = TINY + FAULT
    text += VARY.format(field="task.fire_mm", values="0.5, 1")
    text += VARY.format(field="fault.chamber", values="1, 2, 3")
    found = settings(load_experiment(write(tmp_path, text)))
    assert [setting.number for setting in found] == list(range(6))
    assert found[4].label == "simulation_fire_mm=1_chamber=2"
    assert dict(found[4].values) == {"task.fire_mm": 1, "fault.chamber": 2}


def test_a_field_of_several_numbers_varies_over_lists(tmp_path):
    field = "task.respiration.amplitude_mm"
    text = BREATHING + VARY.format(field=field, values="[2, 2], [10.0, 12.5]")
    path = write(tmp_path, text + VARY.format(field="task.cut_s", values="20.0"))
    spec = load_experiment(path)
    found = settings(spec, read_toml(path)[1])
    amplitudes = [configured(spec, each.values).respiration.amplitude_mm for each in found]
    assert amplitudes == [(2.0, 2.0), (10.0, 12.5)]
    assert [each.label for each in found] == [
        "simulation_amplitude_mm=2-2_cut_s=20",
        "simulation_amplitude_mm=10-12.5_cut_s=20",
    ]
    assert found[1].words == "simulation, amplitude_mm [10, 12.5], cut_s 20.0"
    assert found[1].columns == {field: "[10, 12.5]", "task.cut_s": 20.0}, "cells of a table"
    save_experiment(spec, tmp_path / "experiment.toml")
    assert load_experiment(tmp_path / "experiment.toml") == spec
    (said,) = ExperimentRules(spec).left_out
    assert f"{field} ([2, 2], [10, 12.5], here [5, 20])" in said


def test_large_numbers_have_labels_of_their_own(tmp_path):
    """Six digits are enough below a million, and a file's name has no '+'."""
    seeds = VARY.format(field="rig.robot_seed", values="1000000, 1000001, 2147483647")
    case = '[[cases]]\nname = "a"\nplant = "rig"\n'
    lengths = VARY.format(field="task.world.randomisation.noise_mm", values="0.1234567")
    found = settings(load_experiment(write(tmp_path, TINY + case + seeds + lengths)))
    assert [setting.label for setting in found] == [
        f"a_robot_seed={seed}_noise_mm=0.123457" for seed in ("1000000", "1000001", "2147483647")
    ]
    one = settings(load_experiment(write(tmp_path, TINY)))[0]
    for value, text in ((1e6, "1000000"), (2.5e20, "2.5e20"), (-1e6, "-1000000"), (1e-7, "1e-07")):
        assert replace(one, values=(("a.b", value),)).label == f"simulation_b={text}"


def test_labels_fit_into_the_names_of_files(tmp_path):
    """A file's name has 255 bytes; the run would end where it writes its first row."""
    lesion = f'[[lesions]]\nname = "{"l" * 64}"\ncentre_mm = [0.0, 0.0, 0.0]\n'
    text = TINY + f'[[cases]]\nname = "{"c" * 64}"\n' + lesion
    path = write(tmp_path, text)
    assert len(settings(load_experiment(path))[0].label) == 129
    text += VARY.format(field="task.world.scene_engine.geometry", values=f'"{"batched"}"')
    text += "".join(
        VARY.format(field=f"task.{name}", values="1.23456")
        for name in ("cut_s", "fire_mm", "far_mm", "fine_mm", "approach_s")
    )
    path = write(tmp_path, text)
    with pytest.raises(InputError, match=r"has 2\d\d bytes in its name; expected at most 200"):
        settings(load_experiment(path))


def test_a_field_varies_once_and_a_robot_on_a_rig_only(tmp_path):
    twice = VARY.format(field="task.fire_mm", values="1, 2")
    twice += VARY.format(field="task.fire_mm", values="3, 4")
    case = '[[cases]]\nname = "a"\nplant = "rig"\n'
    robots = VARY.format(field="rig.robot_seed", values="1")
    robots += VARY.format(field="rig.specimen", values="2")
    creep = VARY.format(field="hidden.creep", values="1.0, 2.0")
    for text, said in (
        (twice, "vary[1].field: a second 'task.fire_mm'; expected all values of a field in one"),
        (case + robots, "vary[1].field: a second 'rig.specimen'; expected all values of a field"),
        (creep, "vary[0].field: got 'hidden.creep', which varies on a rig only; expected a case"),
        (robots, "vary[0].field: got 'rig.robot_seed', which varies on a rig only; expected a ca"),
    ):
        path = write(tmp_path, TINY + text)
        with pytest.raises(InputError, match=r"tiny\.toml:\d+: " + re.escape(said)):
            settings(load_experiment(path), read_toml(path)[1])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            FAULT + VARY.format(field="fault.chamber", values="1, 4"),
            "setting 'simulation_chamber=4': fault: chamber 4 of arm 'endoscope', expected 1 to 3",
        ),
        (
            VARY.format(field="task.world.dt_s", values="0.1, 2.0"),
            "setting 'simulation_dt_s=2': limits.time_s is 0.5 s, expected at least a step of 2 s",
        ),
        (
            '[[cases]]\nname = "a"\npolicy = "ring"\n'
            + VARY.format(field="task.preview", values="2, 3"),
            "has 45 observations",
        ),
        (
            '[[cases]]\nname = "a"\nplant = "rig"\n'
            + VARY.format(field="task.world.dt_s", values="0.1, 0.07"),
            "setting 'a_dt_s=0.07': dt_s is 0.07 s; on the rig expected a multiple of its 0.05 s",
        ),
        (
            '[[cases]]\nname = "a"\nplant = "rig"\nrigs = ["virtual:sed=1"]\n',
            "error: rig 'virtual': unknown option 'sed'",
        ),
    ],
)
def test_every_setting_is_built_before_the_first_runs(text, said, tmp_path, capsys):
    """On the rig, too: what one of them cannot have would end the run half way."""
    path, out = write(tmp_path, TINY + text), tmp_path / "out"
    for command in ("check", "run"):
        given = ["-o", str(out)] if command == "run" else []
        assert run(["experiment", command, str(path), *given]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
    assert not out.exists()


def test_hidden_effects_are_for_the_rig(tmp_path):
    case = '[[cases]]\nname = "a"\nhidden = ["creep"]\n'
    with pytest.raises(InputError, match=r"cases\[0\]\.hidden: given for a case in simulat"):
        load_experiment(write(tmp_path, TINY + case))
    checked = case.replace('hidden = ["creep"]', "preflight = true")
    with pytest.raises(InputError, match=r"cases\[0\]\.preflight: given for a case in simulation"):
        load_experiment(write(tmp_path, TINY + checked))
    twice = case.replace('"creep"', '"creep:0.5", "creep:2"') + 'plant = "rig"\n'
    with pytest.raises(InputError, match="a second 'creep'; expected each hidden effect once"):
        settings(load_experiment(write(tmp_path, TINY + twice)))
    text = TINY + case.replace('"creep"', '"grep"') + 'plant = "rig"\n'
    with pytest.raises(InputError, match="unknown hidden effect 'grep'"):
        settings(load_experiment(write(tmp_path, text)))


def test_names_of_the_package_hold_in_any_folder(tmp_path):
    text = re.sub("scene = .*", 'scene = "phantom_liver"', TINY)
    case = '\n[[cases]]\nname = "learned"\npolicy = "ring"\n'
    spec = load_experiment(write(tmp_path, text + case))
    assert spec.scene == str(PHANTOM.resolve())
    assert spec.cases[-1].policy.endswith("policies/ring")
    with pytest.raises(InputError, match="there is no 'rung' beside this file"):
        load_experiment(write(tmp_path, text + case.replace("ring", "rung")))


def test_specs_are_values(tmp_path):
    spec = load_experiment(write(tmp_path))
    assert hash(spec) == hash(load_experiment(write(tmp_path)))
    assert spec != dataclasses.replace(spec, seed=4)


def test_settings_without_bound_are_refused(tmp_path):
    rows = "".join(
        f"\n[[vary]]\nfield = '{name}'\nvalues = [{', '.join(map(str, range(1, 101)))}]\n"
        for name in ("task.cut_s", "task.fire_mm", "task.far_mm")
    )
    with pytest.raises(InputError, match="1000000 settings; expected at most 100000"):
        settings(load_experiment(write(tmp_path, TINY + rows)))


def test_rigs_of_the_command_line_replace_those_of_cases_on_rigs(tmp_path):
    text = TINY.replace("together = 1", "together = 3")
    text += '[[cases]]\nname = "a"\n[[cases]]\nname = "b"\nplant = "rig"\n'
    spec = load_experiment(write(tmp_path, text))
    changed = with_rigs(spec, ("virtual:seed=3",))
    assert [case.rigs for case in changed.cases] == [("virtual",), ("virtual:seed=3",)]
    assert (spec.together, changed.together) == (3, 3)
    found = settings(changed)
    assert rig_config(found[1], Where(tmp_path), spec.of.agents).rigs == ("virtual:seed=3",)
    real = with_rigs(spec, ("laser=tests.rig.own_rig:OwnRig:port=x",), preflight=True)
    of_rig = rig_config(settings(real)[1], Where(tmp_path), spec.of.agents)
    assert of_rig.preflight
    assert real.together == 1, "one bench runs one episode after the other"
    save_experiment(real, tmp_path / "saved.toml")
    assert load_experiment(tmp_path / "saved.toml") == real
    simulated = load_experiment(write(tmp_path))
    with pytest.raises(InputError, match="no case with plant = 'rig'"):
        with_rigs(simulated, ("virtual",))
    with pytest.raises(InputError, match="no arm 'knife'"):
        with_rigs(spec, ("knife=virtual",))
    for text, message in (
        ("nothere", "unknown rig 'nothere'"),
        ("laser=virtual:sed=1", "unknown option 'sed'"),
        ("virtual:seed=x", "seed"),
    ):
        with pytest.raises(InputError, match=message):
            with_rigs(spec, (text,))


@pytest.mark.parametrize("value", ["[]", "{}", "1", '"cure"'])
def test_a_scenario_that_is_no_name_is_one_line(tmp_path, value):
    path = write(tmp_path, f"scenario = {value}\n{TINY}")
    with pytest.raises(InputError, match=r"tiny\.toml:1: scenario: got"):
        load_experiment(path)


LESION = '[[phases]]\nname = "a"\ntimeout_s = 1.0\n[[lesions]]\nname = "b"\ncentre_mm = [0, 0, 0]\n'
CONTROLLER = '[[controllers]]\nname = "{name}"\n{what}\n'
CONTRADICTIONS = {
    "task: got": ("", "task = 1\n"),
    "task.scene: does not belong here": ("", '[task]\nscene = "x"\n'),
    "phases: none is given": ("", "phases = []\n"),
    "controllers[0].name: got 'policy'; expected none of": (
        CONTROLLER.format(name="policy", what="waypoints = [[0.0, 1.0, 1.0, 1.0]]"),
        "",
    ),
    "controllers[0]: got both or neither": (CONTROLLER.format(name="mine", what=""), ""),
    "controllers[0].waypoints: times [1.0, 1.0]": (
        CONTROLLER.format(
            name="mine", what="waypoints = [[1.0, 1.0, 1.0, 1.0], [1.0, 2.0, 2.0, 2.0]]"
        ),
        "",
    ),
    "phases: got integer 1; expected a list": ("", "phases = 1\n"),
    "lesions: contour_ablation treats contours here": (
        "",
        'scenario = "contour_ablation"\n[[task.contours]]\nname = "a"\n'
        "centre_mm = [0.0, 0.0, 0.0]\n" + LESION,
    ),
    "faults[0].arm: got 'gripper'": (FAULT.replace("endoscope", "gripper"), ""),
}


def test_lesions_belong_to_a_scene(tmp_path):
    path = write(tmp_path, 'name = "tiny"\nscenario = "track_circle"\n' + LESION)
    with pytest.raises(InputError, match="lesions: got lesions; expected none: track_circle has"):
        load_experiment(path)


def test_paths_of_a_controller_and_of_an_arm_follow_the_configuration(tmp_path):
    """The exact configuration lies in the folder of results: its paths are relative to that."""
    (tmp_path / "push.csv").write_text("t_s,c1_kPa,c2_kPa,c3_kPa\n0,0,0,0\n1,5,0,0\n")
    (tmp_path / "arm").mkdir()
    own = CONTROLLER.format(name="push", what='schedule = "push.csv"') + CONTROLLER.format(
        name="sweep", what="waypoints = [[0.0, 1.0, 1.0, 1.0], [2.5, 2.0, 2.0, 2.0]]"
    )
    case = '[[cases]]\nname = "mine"\narm = "arm"\n'
    spec = load_experiment(write(tmp_path, TINY + own + case))
    assert spec.controllers[0].schedule == str(tmp_path / "push.csv")
    assert spec.cases[0].arm == str(tmp_path / "arm")
    assert [row[0] for row in spec.controllers[1].waypoints] == [0.0, 2.5]
    (tmp_path / "results").mkdir()
    save_experiment(spec, tmp_path / "results" / "experiment.toml")
    text = (tmp_path / "results" / "experiment.toml").read_text()
    assert 'schedule = "../push.csv"' in text
    assert 'arm = "../arm"' in text
    assert load_experiment(tmp_path / "results" / "experiment.toml") == spec


@pytest.mark.parametrize("said", CONTRADICTIONS)
def test_fields_that_do_not_fit_each_other_are_named(said, tmp_path):
    """behind: added to the tiny experiment; instead: the whole file but its scene."""
    behind, instead = CONTRADICTIONS[said]
    head = 'name = "tiny"\nscene = "{scene}"\n'
    path = write(tmp_path, head + instead if instead else TINY + behind)
    with pytest.raises(InputError, match=re.escape(said)) as caught:
        load_experiment(path)
    assert "\n" not in str(caught.value)


def test_files_with_former_names_open(tmp_path):
    """`drivers`, `specimen` and `rig.specimen` have other names since, and mean the same."""
    own = CONTROLLER.format(name="sweep", what="waypoints = [[0.0, 1.0, 1.0, 1.0]]")
    case = '[[cases]]\nname = "a"\nplant = "rig"\nrobot_seed = 3\n'
    vary = VARY.format(field="rig.robot_seed", values="4, 5")
    present = load_experiment(write(tmp_path, TINY + own + case))
    old = (own + case).replace("controllers", "drivers").replace("robot_seed", "specimen")
    assert load_experiment(write(tmp_path, TINY + old)) == present
    assert present.cases[0].robot_seed == 3
    seeds = []
    for text in (vary, vary.replace("rig.robot_seed", "rig.specimen")):
        spec = load_experiment(write(tmp_path, TINY + case + text))
        rigs = [rig_config(each, Where(tmp_path), ("laser",)) for each in settings(spec)]
        seeds.append([rig.seed for rig in rigs])
    assert seeds == [[4, 5], [4, 5]]
    both = case + "specimen = 3\n"
    with pytest.raises(InputError, match="got specimen and robot_seed; expected robot_seed alone"):
        load_experiment(write(tmp_path, TINY + both))


def test_check_names_the_limit_of_clearance_that_holds(tmp_path, capsys):
    """The scene's is 1 mm; a looser one in the file has no effect."""
    for given, said in (
        ("", "beam off below 1 mm of clearance, the scene's limit\n"),
        ("clearance_mm = 3.0", "beam off below 3 mm of clearance\n"),
        ("clearance_mm = 0.5", "limit; limits.clearance_mm = 0.5 is below it and has no effect\n"),
    ):
        path = write(tmp_path, TINY.replace("[limits]", f"[limits]\n{given}"))
        assert run(["experiment", "check", str(path)]) == 0
        printed = capsys.readouterr().out
        assert said in printed
        assert "until centred (1), at most 0.3 s, then go on" in printed


def test_check_says_whose_threshold_of_sight_it_is(tmp_path, capsys):
    """0, the default, is below the scene's view_fraction, which holds."""
    seen = TINY.replace('until = "centred"', 'until = "seen"')
    for given, said in (
        ("", "seen (view_fraction of the scene)"),
        ("within = 0.5\n", "seen (0.5)"),
    ):
        path = write(tmp_path, seen.replace('until = "seen"', f'until = "seen"\n{given}'))
        assert run(["experiment", "check", str(path)]) == 0
        assert f"until {said}, at most 0.3 s" in capsys.readouterr().out


def test_a_folder_of_that_name_does_not_hide_a_packaged_experiment(tmp_path, monkeypatch):
    (tmp_path / "liver").mkdir()
    monkeypatch.chdir(tmp_path)
    assert find_experiment("liver") == PHANTOM / "experiments" / "liver.toml"
    with pytest.raises(
        InputError, match=r"'livr': known are area, .*did you mean 'liver'\?; or gi"
    ):
        find_experiment("livr")
    (tmp_path / "fault").touch()
    assert find_experiment("fault") == Path("fault"), "a file is meant"
