"""Experiments that cannot be meant, and rare ways through those that can."""

import io
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from surgisoft.agents.run_folder import PACKAGED
from surgisoft.cli import run
from surgisoft.config import read_toml
from surgisoft.errors import InputError
from surgisoft.experiments.controllers import PhaseControllers, Schedule
from surgisoft.experiments.phases import PhasedTask, with_phase_events
from surgisoft.experiments.pictures import film
from surgisoft.experiments.plan import build_task, rig_config, scene_of, settings
from surgisoft.experiments.run import jobs, open_results, read_rows, row_file, run_experiment
from surgisoft.experiments.session import (
    experiments_of,
    start_experiment,
    with_policy,
    with_rigs,
)
from surgisoft.experiments.spec import Fault, Lesion, load_experiment, save_experiment
from surgisoft.files import write_json
from surgisoft.scene.spec import PHANTOM
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.circle_ablation import CircleAblation
from surgisoft.tasks.laser_supervision import LaserSupervision
from surgisoft.tasks.observations import TIME
from surgisoft.tasks.registry import with_fields
from tests.experiments.tiny import BREATHING, FAULT, TINY, write
from tests.rig.own_rig import OwnRig
from tests.tasks.test_episode import made_up

VARY = '[[vary]]\nfield = "{field}"\nvalues = [{values}]\n'
RIG = '[[cases]]\nname = "rig"\nplant = "rig"\n'


def spec_of(folder, text: str = TINY):
    return load_experiment(write(folder, text))


@pytest.mark.parametrize(
    ("field", "values", "message"),
    [
        ("task.fire_mm", "1.0, 1.0", "'simulation_fire_mm=1' appears twice; expected values that"),
        ("hidden.creep", "-1.0", "got -1.0; expected amplitudes from 0"),
        ("hidden.creep", '"much"', "got 'much'; expected amplitudes from 0"),
        ("hidden.creep", "[1.0, 2.0]", "got (1.0, 2.0); expected amplitudes from 0"),
        ("fault.chamber", "0", "got 0; expected what a fault has as chamber"),
        ("fault.at_s", "-0.5", "got -0.5; expected what a fault has as at_s"),
    ],
)
def test_values_that_cannot_vary_are_named(field, values, message, tmp_path):
    path = write(tmp_path, TINY + FAULT + VARY.format(field=field, values=values))
    with pytest.raises(InputError, match=re.escape(message)):
        settings(load_experiment(path), read_toml(path)[1])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            "2.0, 10.0",
            "got 2.0, where a value of {} is a list of numbers; expected each value as a",
        ),
        ("2.0, 10.0", "as a list itself, such as values = [[2, 10], ...]"),
        ("2.0, 3.0, 4.0", "as a list itself, such as values = [[5, 20], ...]"),
        ("[2.0, 10.0], 4.0", "got 4.0, where a value of {} is a list of numbers"),
        ("[2.0, 10.0], [4.0]", "values[1]: {}: got a list [4.0]; expected 2 numbers"),
    ],
)
def test_each_value_of_a_field_of_two_numbers_is_a_list(values, message, tmp_path):
    """The three numbers fit no value of the field, so its own value is the example."""
    field = "task.respiration.amplitude_mm"
    path = write(tmp_path, BREATHING + VARY.format(field=field, values=values))
    with pytest.raises(InputError, match=re.escape(message.format(field))):
        settings(load_experiment(path), read_toml(path)[1])


def test_hidden_effects_and_robots_vary_on_the_rig(tmp_path):
    text = TINY + RIG + VARY.format(field="hidden.creep", values="0.0, 2.0")
    text += VARY.format(field="rig.robot_seed", values="3, 4")
    spec = spec_of(tmp_path, text)
    found = [rig_config(each, None, spec.of.agents) for each in settings(spec)]
    assert [(each.seed, each.hidden) for each in found] == [
        (3, ()),
        (4, ()),
        (3, (("creep", 2.0),)),
        (4, (("creep", 2.0),)),
    ]
    plain = spec_of(tmp_path, TINY + '[[cases]]\nname = "plain"\n' + text.removeprefix(TINY))
    labels = [each.label for each in settings(plain)]
    assert labels[0] == "plain", "once: in simulation the two make no difference"
    assert labels[1:] == [each.label for each in settings(spec)]
    wrong = RIG + 'hidden = ["creep:much"]\n'
    with pytest.raises(InputError, match=r"got 'creep:much'; expected NAME or NAME:STRENGTH"):
        settings(spec_of(tmp_path, TINY + wrong))
    for strength in ("-1", "nan"):
        wrong = RIG + f'hidden = ["creep:{strength}"]\n'
        with pytest.raises(InputError, match=f"strength of 'creep' is {strength}; expected a numb"):
            settings(spec_of(tmp_path, TINY + wrong))


def test_an_episode_has_a_step(tmp_path):
    spec = spec_of(tmp_path)
    short = replace(spec, limits=replace(spec.limits, time_s=0.04))
    (setting,) = settings(short)
    with pytest.raises(InputError, match=r"time_s is 0\.04 s, expected at least a step of 0\.1 s"):
        build_task(short, setting)


def test_an_episode_has_an_end(tmp_path):
    """As many steps as any task may have, and one more."""
    spec = spec_of(tmp_path)
    fine = replace(spec, task=with_fields(spec.task, dt_s=0.001))
    (setting,) = settings(fine)
    longest = replace(fine, limits=replace(fine.limits, time_s=10_000.0))
    assert build_task(longest, setting).steps == 10_000_000
    longer = replace(fine, limits=replace(fine.limits, time_s=10_000.001))
    with pytest.raises(
        InputError, match=r"time_s is 10000 s, more than 10,000,000 steps of 0\.001"
    ):
        build_task(longer, setting)


def test_time_stays_within_its_range_in_longer_experiments(tmp_path, capsys):
    """The packaged policy was trained in episodes of 60 s; the experiment lasts 90 s."""
    text = TINY.replace("time_s = 0.5", "time_s = 90.0")
    file = write(tmp_path, text + '[[cases]]\nname = "learned"\npolicy = "ring"\n')
    spec = load_experiment(file)
    task = build_task(spec, settings(spec)[0])
    assert (task.base.steps, task.steps) == (600, 900)
    state = Episodes(task).seeded(0, 3)
    steps = torch.tensor([150, 600, 900])
    state = replace(state, world=replace(state.world, steps=steps))
    for blocks in task.base.blocks(task.plain(state)).values():
        assert blocks[TIME].squeeze(1).tolist() == [0.25, 1.0, 1.0]
    assert run(["experiment", "check", str(file)]) == 0
    said = capsys.readouterr().err
    assert "ring was trained in episodes of 60 s, and those of tiny last up to 90 s" in said
    file = write(tmp_path, file.read_text().replace("time_s = 90.0", "time_s = 60.0"))
    assert run(["experiment", "check", str(file)]) == 0
    assert "was trained in" not in capsys.readouterr().err


def test_scenes_vary_by_cases(tmp_path):
    vary = '[[vary]]\nfield = "task.scene"\nvalues = ["a", "b"]\n'
    with pytest.raises(InputError, match=r"expected a case for each scene: \[\[cases\]\] with sce"):
        settings(load_experiment(write(tmp_path, TINY + vary)))
    case = '[[cases]]\nname = "a"\nscene = "nowhere"\n'
    with pytest.raises(InputError, match="nowhere"):
        load_experiment(write(tmp_path, TINY + case))
    text = 'name = "t"\nscenario = "track_circle"\n[[phases]]\nname = "go"\ntimeout_s = 1.0\n'
    with pytest.raises(InputError, match="expected none: track_circle has no scene"):
        load_experiment(write(tmp_path, text + case))


def test_a_policy_of_another_scene_is_told_by_check_run_and_report(tmp_path, capsys):
    """The packaged policy was trained on the phantom; the experiment's scene has a smaller ring."""
    other = tmp_path / "other"
    shutil.copytree(PHANTOM, other)
    file = other / "scene.toml"
    file.write_text(file.read_text().replace("diameter_mm = 20.0", "diameter_mm = 18.0", 1))
    case = '[[cases]]\nname = "learned"\npolicy = "ring"\n'
    brief = TINY.replace("repeats = 3", "repeats = 1").replace("time_s = 0.5", "time_s = 0.2")
    line = "ring was trained in another scene (phantom_liver) than other; its result here says"
    plain = write(tmp_path, brief + case)
    elsewhere = tmp_path / "elsewhere.toml"
    elsewhere.write_text(plain.read_text().replace(str(PHANTOM), str(other)))
    assert run(["experiment", "check", str(plain)]) == 0
    assert "another scene" not in capsys.readouterr().err
    assert run(["experiment", "check", str(elsewhere)]) == 0
    assert line in capsys.readouterr().err
    results = tmp_path / "results"
    assert run(["experiment", "run", str(elsewhere), "-o", str(results), "--no-replays"]) == 0
    assert line in capsys.readouterr().err
    assert line in (results / "report.html").read_text()


def test_a_lesion_of_an_experiment_keeps_the_scenes_clearance(tmp_path):
    """In `multi_lesion` the ring `right` is 47.4 mm from the gallbladder, `left` 54.1 mm."""
    scene = tmp_path / "strict"
    shutil.copytree(PHANTOM, scene)
    file = scene / "scene.toml"
    file.write_text(file.read_text().replace("clearance_mm = 1.0", "clearance_mm = 50.0", 1))
    packaged = (PHANTOM / "experiments" / "multi_lesion.toml").read_text()
    text = re.sub(r'^scene = ".*"', f'scene = "{scene}"', packaged, count=1, flags=re.MULTILINE)
    spec = spec_of(tmp_path, text)
    by_lesion = {setting.lesion.name: setting for setting in settings(spec)}
    assert scene_of(spec, by_lesion["left"]).spec.lesion.body == "liver"
    said = "lesion 'right': its ring is 47.4 mm from 'gallbladder', expected at least 50 mm"
    with pytest.raises(InputError, match=said):
        scene_of(spec, by_lesion["right"])


def test_a_lesion_of_an_experiment_lies_on_the_organ(tmp_path):
    spec = spec_of(tmp_path)
    (setting,) = settings(spec)
    own = scene_of(spec, setting)
    moved = replace(setting, lesion=Lesion("here", tuple(own.ring.centre_mm), 12.0))
    assert scene_of(spec, moved).spec.lesion.diameter_mm == 12.0
    away = replace(setting, lesion=Lesion("away", (1e4, 0.0, 0.0), 12.0))
    with pytest.raises(InputError, match="lesion 'away': "):
        scene_of(spec, away)


def test_a_case_may_have_an_arm_model_of_its_own(tmp_path):
    spec = spec_of(tmp_path)
    (setting,) = settings(spec)
    with pytest.raises(InputError, match="no arm model there"):
        build_task(spec, replace(setting, case=replace(setting.case, arm=str(tmp_path / "none"))))


def test_folders_and_options_that_do_not_fit(tmp_path):
    (run,) = (path for path in PACKAGED.iterdir() if (path / "config.json").is_file())
    spec = spec_of(tmp_path)
    (tmp_path / "empty").mkdir()
    file = write(tmp_path)
    line = 'scenario = "track_circle"\n[[phases]]\nname = "a"\ntimeout_s = 1.0\narm = "policy"\n'
    other = load_experiment(write(tmp_path, 'name = "tiny"\n' + line, "other.toml"))
    twice = with_policy(spec, run)
    assert [case.name for case in twice.cases] == ["simulation", f"simulation-{run.name}"]
    assert twice.cases[1].policy == str(run.resolve())
    odd = tmp_path / f"my run.v2 {'x' * 64}"
    shutil.copytree(run, odd)
    save_experiment(with_policy(spec, odd), tmp_path / "odd.toml")
    named = load_experiment(tmp_path / "odd.toml").cases[1].name
    assert named == f"simulation-my_run_v2_{'x' * 64}"[:64]
    out = tmp_path / "out"
    for call, message in (
        (lambda: experiments_of(tmp_path / "empty"), "no experiment (*.toml) there"),
        (lambda: with_policy(other, run), "was trained on circle_ablation; expected a run of trac"),
        (lambda: with_policy(twice, run), "there is a case of that name already; rename the fold"),
        (lambda: start_experiment(file, out, resume=True, force=True), "--resume continues resul"),
        (lambda: start_experiment(file, out, preflight=True), "--preflight is for real rigs; nam"),
        (lambda: start_experiment(file, out, rigs=["virtual"]), "no case with plant = 'rig' that"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            call()
    assert not out.exists()
    on_rig, folder = start_experiment(
        write(tmp_path, TINY + RIG), out, policies=[run], rigs=["virtual:seed=5"], repeats=2
    )
    assert (on_rig.repeats, folder) == (2, out)
    assert [case.rigs for case in on_rig.cases if case.plant == "rig"] == [("virtual:seed=5",)] * 2


def test_benches_are_opened_before_anything_is_written(tmp_path, monkeypatch, capsys):
    """A missing device or another arm is one line before the simulated cases; a bench that opens
    is given back, and results that are complete need none."""
    closed: list[str] = []
    monkeypatch.setattr(OwnRig, "close", lambda rig: closed.append(rig.port))
    file = write(tmp_path, TINY + '[[cases]]\nname = "simulation"\n' + RIG)
    own, out = "laser=tests.rig.own_rig:OwnRig:port=a", tmp_path / "out"
    missing = f"serial:port={tmp_path / 'ttyNOPE'}"
    for rig, said in (
        (f"laser={missing}", "cannot be opened"),
        (f"{own},chambers=4", "arm 'laser' has 3 chambers and 5 key points; the rig's has 4 and 5"),
    ):
        assert run(["experiment", "run", str(file), "--rig", rig, "-o", str(out)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert said in line
        assert not out.exists()
    assert closed == ["a"]
    spec, _ = start_experiment(file, out, rigs=[own])
    assert closed == ["a", "a"]
    with pytest.raises(InputError, match="cannot be opened"):
        open_results(with_rigs(spec, [missing]), tmp_path / "other")
    varied = TINY + RIG + VARY.format(field="hidden.creep", values="0.0, 1.0")
    with pytest.raises(InputError, match=r"OwnRig': unknown option 'hidden'"):
        start_experiment(write(tmp_path, varied, "varied.toml"), tmp_path / "other", rigs=[own])
    assert not (tmp_path / "other").exists()
    closed[2:] = []
    open_results(with_rigs(spec, [missing]), tmp_path / "other", cluster="tcp://elsewhere:8786")
    for job in jobs(spec):
        for episode in range(job.first, job.first + job.count):
            write_json(row_file(out, job.setting, episode), {})
    open_results(spec, out, resume=True)
    assert closed == ["a", "a"]


@pytest.fixture(scope="module")
def phased(tmp_path_factory):
    """A phased task whose arms rest, follow a file, and go through points; and two episodes."""
    folder = tmp_path_factory.mktemp("phased")
    (folder / "push.csv").write_text("t_s,c1_kPa,c2_kPa,c3_kPa\n0,1,1,1\n9,1,1,1\n")
    text = TINY.replace('laser = "policy"', 'laser = "push"').replace(
        'name = "look"\nendoscope = "policy"', 'name = "look"\nendoscope = "rest"\nlaser = "go"'
    )
    text += '[[controllers]]\nname = "push"\nschedule = "push.csv"\n'
    text += '[[controllers]]\nname = "go"\nwaypoints = [[0.0, 0.0, 0.0, 0.0]]\n'
    text += '[[controllers]]\nname = "unused"\nwaypoints = [[0.0, 0.0, 0.0, 0.0]]\n'
    spec = spec_of(folder, text)
    task = PhasedTask(LaserSupervision(CircleAblation(replace(spec.task, scene=spec.scene))), spec)
    return spec, task, Episodes(task).seeded(0, 2)


def test_each_arm_follows_the_controller_of_its_phase(phased):
    """Episode 0 is in the first phase, episode 1 in the second."""
    spec, task, state = phased
    state = replace(state, goal=replace(state.goal, phase=torch.tensor([0, 1])))
    controllers = PhaseControllers(spec, task, "scripted")
    assert sorted(controllers.defined) == [("laser", "go"), ("laser", "push")]
    actions = controllers.act(task, state, {})
    part = state.world.arms["endoscope"]
    rest = task.world.arms["endoscope"].first - part.command
    torch.testing.assert_close(actions["endoscope"][0], rest[0])
    laser = state.world.arms["laser"]
    torch.testing.assert_close(actions["laser"][1], 1.0 - laser.command[1])
    expert = task.script(state)["endoscope"]
    torch.testing.assert_close(actions["endoscope"][1], expert[1])


def test_a_schedule_of_several_runs_is_no_controller(tmp_path):
    file = tmp_path / "two.csv"
    file.write_text("t_s,run,c1_kPa\n0,0,1\n1,0,1\n0,1,1\n1,1,1\n")
    with pytest.raises(InputError, match=r"two\.csv: 2 runs; expected one"):
        Schedule(file, 1)


def test_a_fault_after_the_end_is_no_event(phased):
    spec, *_ = phased
    log = made_up(measures={"phase": torch.zeros(6).numpy(), "reason": torch.zeros(6).numpy()})
    faults = (Fault("laser", 2.0, 1), Fault("laser", 99.0, 1))
    found = with_phase_events(replace(spec, faults=faults), log).events
    assert [event.time_s for event in found if "fault" in event.text] == [2.0]


def test_a_folder_of_experiments_is_that_of_its_scene(tmp_path):
    shutil.copy(write(tmp_path), tmp_path / "second.toml")
    assert [path.name for path in experiments_of(tmp_path)] == ["second.toml", "tiny.toml"]


def test_a_copy_of_an_experiment_names_its_files_from_its_own_folder(tmp_path):
    (tmp_path / "push.csv").write_text("t_s,c1_kPa,c2_kPa,c3_kPa\n0,0,0,0\n1,1,1,1\n")
    text = TINY + '[[controllers]]\nname = "unused"\nschedule = "push.csv"\n'
    spec = spec_of(tmp_path, text)
    (tmp_path / "results").mkdir()
    save_experiment(spec, tmp_path / "results" / "experiment.toml")
    assert 'schedule = "../push.csv"' in (tmp_path / "results" / "experiment.toml").read_text()
    assert load_experiment(tmp_path / "results" / "experiment.toml") == spec


def test_results_go_on_only_with_their_own_scene(tmp_path):
    spec, folder = spec_of(tmp_path), tmp_path / "results"
    open_results(spec, folder)
    open_results(spec, folder, resume=True)
    with pytest.raises(InputError, match="results already exist; --resume continues them"):
        open_results(spec, folder)
    more = replace(spec, repeats=spec.repeats + 1)
    with pytest.raises(InputError, match=r"experiment.toml differs in repeats\); run that file"):
        open_results(more, folder, resume=True)
    went_on, _ = start_experiment(folder / "experiment.toml", folder, resume=True)
    assert went_on == spec
    about = json.loads((folder / "versions.json").read_text())
    (folder / "versions.json").write_text(json.dumps(about | {"scene_hash": "0"}))
    with pytest.raises(InputError, match="has changed since the results began"):
        open_results(spec, folder, resume=True)
    with pytest.raises(InputError, match="exists and holds no results of an experiment"):
        open_results(spec, tmp_path)


def test_settings_that_are_left_are_built_before_results_go_on(tmp_path):
    """A policy without weights is one line before the first run, unless its episodes are there."""
    shipped = next(path for path in PACKAGED.iterdir() if (path / "config.json").is_file())
    learned = tmp_path / "learned"
    shutil.copytree(shipped, learned)
    spec, told = with_policy(spec_of(tmp_path), learned), []
    open_results(spec, tmp_path / "r", progress=lambda *given: told.append(given[:2]))
    assert told == [(0, 2), (1, 2)]
    shutil.rmtree(learned / "checkpoints")
    with pytest.raises(InputError, match=r"setting '.*learned': .*checkpoints"):
        open_results(spec, tmp_path / "r", resume=True)
    for job in jobs(spec):
        if job.setting.case.policy == str(learned):
            for episode in range(job.first, job.first + job.count):
                write_json(row_file(tmp_path / "r", job.setting, episode), {})
    open_results(spec, tmp_path / "r", resume=True)


def test_processes_beside_a_cluster_are_refused(tmp_path, monkeypatch, capsys):
    file, out = write(tmp_path), tmp_path / "out"
    given = ["experiment", "run", str(file), "-o", str(out), "--processes", "2"]
    assert run([*given, "--cluster", "tcp://host:8786"]) == 2
    assert capsys.readouterr().err == (
        "surgisoft: error: --processes 2 has no effect: the workers of tcp://host:8786, by "
        "--cluster, do the work; leave --processes out\n"
    )
    monkeypatch.setenv("SURGISOFT_CLUSTER", "tcp://other:8786")
    assert run(given) == 2
    assert "of tcp://other:8786, by the environment variable" in capsys.readouterr().err
    with pytest.raises(InputError, match="--processes 2 has no effect"):
        run_experiment(spec_of(tmp_path), out, processes=2, cluster="tcp://host:8786")
    assert not out.exists()


def test_results_go_on_only_with_their_own_policy_and_arm_models(tmp_path):
    """The run's checkpoint and the arm model are those of another training, in the same folders.

    A case whose episodes are all there goes on as it is: nothing of it is computed again. Results
    of before, which state the scene alone, go on, too."""
    run_folder, arm = tmp_path / "run", tmp_path / "arm"
    shutil.copytree(PACKAGED / "ring", run_folder)
    shutil.copytree(run_folder / "arms" / "laser", arm)
    cases = (
        f'[[cases]]\nname = "learned"\npolicy = "{run_folder}"\n'
        f'[[cases]]\nname = "ours"\narm = "{arm}"\n'
    )
    spec, folder = spec_of(tmp_path, TINY + cases), tmp_path / "results"
    open_results(spec, folder)
    open_results(spec, folder, resume=True)

    checkpoint = run_folder / "checkpoints" / "best.pt"
    kept, saved = checkpoint.read_bytes(), torch.load(checkpoint, weights_only=True)
    weights = saved["agents"]["laser"]
    name = next(name for name, value in weights.items() if value.is_floating_point())
    weights[name] = weights[name] + 0.01
    torch.save(saved, checkpoint)
    said = "the policy '.*run' of its case 'learned' has changed since the results began"
    with pytest.raises(InputError, match=said):
        open_results(spec, folder, resume=True)
    checkpoint.write_bytes(kept)
    open_results(spec, folder, resume=True)

    other = load_model(arm)
    with torch.no_grad():
        next(iter(other.parameters())).add_(0.01)
    save_model(other, arm, force=True)
    said = "the arm model of '(laser|endoscope)' of its case 'ours' has changed since the results"
    with pytest.raises(InputError, match=said):
        open_results(spec, folder, resume=True)
    file = folder / "versions.json"
    about = json.loads(file.read_text())
    write_json(file, {name: value for name, value in about.items() if name != "cases"})
    open_results(spec, folder, resume=True)
    write_json(file, about)
    for job in jobs(spec):
        for episode in range(job.first, job.first + job.count):
            if job.setting.case.name == "ours":
                write_json(row_file(folder, job.setting, episode), {})
    open_results(spec, folder, resume=True)


def test_results_go_on_only_with_every_arm_model_that_varies(tmp_path):
    """The model of the second value of `task.arm` is another one, in the same folder."""
    first, second = tmp_path / "one", tmp_path / "two"
    for folder in (first, second):
        shutil.copytree(PACKAGED / "ring" / "arms" / "laser", folder)
    vary = f'\n[[vary]]\nfield = "task.arm"\nvalues = ["{first}", "{second}"]\n'
    spec, folder = spec_of(tmp_path, TINY + vary), tmp_path / "results"
    open_results(spec, folder)
    open_results(spec, folder, resume=True)
    other = load_model(second)
    with torch.no_grad():
        next(iter(other.parameters())).add_(0.01)
    save_model(other, second, force=True)
    said = rf"the arm model of '\w+' with task\.arm = '{second}' of its case .* has changed"
    with pytest.raises(InputError, match=said):
        open_results(spec, folder, resume=True)


@pytest.mark.parametrize(
    "value", [{}, [1.0], True, 10**400], ids=["a table", "a list", "a truth value", "too large"]
)
def test_rows_hold_texts_and_numbers(tmp_path, value):
    """Also where all rows have the same kind of value in a field."""
    spec = spec_of(tmp_path)
    every = jobs(spec)
    row = {"case": "a", "outcome": "done", "success": 0.0, "time_s": 1.0}
    for job in every:
        for episode in range(job.first, job.first + job.count):
            file = row_file(tmp_path, job.setting, episode)
            about = {"setting": job.setting.label, "episode": episode}
            file.parent.mkdir(exist_ok=True)
            file.write_text(json.dumps(row | about))
    assert len(read_rows(tmp_path, every)) == sum(job.count for job in every)
    for file in (tmp_path / "rows").glob("*.json"):
        file.write_text(json.dumps(json.loads(file.read_text()) | {"time_s": value}))
    with pytest.raises(InputError, match="is not the row of episode 0"):
        read_rows(tmp_path, every)


def test_a_film_ends_where_the_arms_are_finite(monkeypatch):
    """Of six seconds the arm is not finite in the last two, of which there is no picture."""
    log, drawn = made_up(cameras={"arm": object()}), []
    line_mm = np.zeros((6, 2, 3))
    line_mm[4:] = np.nan
    log = replace(log, arms={"arm": replace(log.arms["arm"], line_mm=line_mm)})

    def pictures(log, name, rows):
        drawn.extend(rows.tolist())
        file = io.BytesIO()
        Image.new("RGB", (8, 8)).save(file, "JPEG")
        return [file.getvalue()] * len(rows)

    monkeypatch.setattr("surgisoft.replay.endoscope.jpegs", pictures)
    assert film(log, 3).caption == "What the endoscope saw at 0.0, 3.0 s"
    assert drawn == [0, 3]
