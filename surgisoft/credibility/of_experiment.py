"""The credibility report of a scenario: an experiment's results and its arm's recordings."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from surgisoft.credibility.assessment import Assessment, assess
from surgisoft.credibility.context import Context
from surgisoft.credibility.scenario import outcomes
from surgisoft.diagnosis.compare import compare
from surgisoft.errors import InputError
from surgisoft.experiments.plan import scene_folder
from surgisoft.experiments.results import Results
from surgisoft.experiments.spec import Experiment
from surgisoft.measurement.recordings import load_recordings
from surgisoft.scene.folder import open_scene
from surgisoft.surrogate.checkpoint import load_model


def assess_experiment(
    context: Context, results: Results, progress: Callable[[str], None] = lambda text: None
) -> Assessment:
    """Assess the arm model of an experiment for the scenario that the experiment rolls out.

    The model is the context's, else that of the experiment; the comparators are the context's
    recordings; the states are those of the stored episodes, with those that the context names.
    """
    spec = results.experiment
    check_context(context, spec)
    model = context.model or arm_of(spec)
    states = (str(results.folder), *context.scenario.states)
    context = replace(context, scenario=replace(context.scenario, states=states))
    progress("comparing")
    recordings = load_recordings(context.recordings)
    comparison, table = compare(model, recordings)
    return assess(context, comparison, table, recordings, outcomes(results), progress)


def check_context(context: Context, spec: Experiment) -> None:
    """Raise InputError for a context that does not fit, before an experiment is run for it."""
    if not context.recordings:
        raise InputError(
            "the context names no recordings of the arm; expected recordings = ['FILE', ...] there"
        )
    load_model(context.model or arm_of(spec))
    load_recordings(context.recordings)


def arm_of(spec: Experiment) -> str:
    """The arm model of an experiment: of its cases, its task, or the mounts of its scene."""
    stated = getattr(spec.task, "arm", None)
    default = {str(stated)} if stated else {"default"}

    def of_scene(folder: str) -> set[str]:
        names = {mount.arm for mount in open_scene(folder).spec.mounts}
        return {str(at) if (at := Path(folder) / name).is_dir() else name for name in names}

    arms: set[str] = set()
    for case in spec.cases:
        in_scene = spec.in_scene and not stated and not case.arm
        own = {case.arm} if case.arm else default
        arms |= of_scene(scene_folder(spec, case)) if in_scene else own
    if len(arms) > 1:
        raise InputError(
            f"the experiment has the arm models {', '.join(sorted(arms))}; expected model = NAME "
            "in the context, the one that its recordings were made on"
        )
    (arm,) = arms
    return arm
