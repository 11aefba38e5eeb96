"""Multi-agent surgical scenarios for soft robots, with arm models validated by measurements.

The names below are the package's functions. Each takes paths or objects and gives the result of
the command of its name. They are imported when they are first used: `import surgisoft` is quick.

System identification of an arm:

    load_model, save_model       a model's folder <-> `ArmModel`
    load_recording(s), save_recording
    collect                      a recording from a rig, by default the virtual one
    import_recordings            a laboratory's files -> recordings
    fit                          recordings -> model (grey-box: network and physical effects)
    compare                      a model's error, and what the error depends on
    diagnose                     the physical effect that a model lacks
    next_experiment              the experiment that best distinguishes competing effects
    amend, improve               add effects, and validate them on held-out data
    register_effect_file         a user-defined effect

Surgical tasks:

    make, parallel_env           Gymnasium and PettingZoo environments
    batched_env                  thousands of episodes, tensors in and out
    train, evaluate              policies (PPO, centralised training, decentralised execution)
    run                          a policy or a schedule on a rig, with a model beside it
    open_scene, open_replay      scenes and episodes
    demo                         the demonstration in five steps
"""

from importlib import import_module
from typing import TYPE_CHECKING

from surgisoft.environments import register_with_gymnasium
from surgisoft.extras import missing_library

__version__ = "0.1.0"

if TYPE_CHECKING:
    from surgisoft.agents.session import evaluate
    from surgisoft.agents.training_request import train
    from surgisoft.demonstration.story import demo
    from surgisoft.diagnosis.amend import amend
    from surgisoft.diagnosis.compare import compare
    from surgisoft.diagnosis.design.next_experiment import next_experiment
    from surgisoft.diagnosis.diagnose import diagnose
    from surgisoft.diagnosis.improve import improve
    from surgisoft.live.session import run
    from surgisoft.measurement.fitting import fit
    from surgisoft.measurement.importing import import_recordings
    from surgisoft.measurement.recordings import (
        load_recording,
        load_recordings,
        save_recording,
    )
    from surgisoft.replay.show import open_replay
    from surgisoft.rig.trial import collect
    from surgisoft.scene.folder import open_scene
    from surgisoft.surrogate.checkpoint import load_model, save_model
    from surgisoft.surrogate.checkpoint import load_model as load
    from surgisoft.surrogate.effects import register_effect_file
    from surgisoft.tasks.batched import batched_env
    from surgisoft.tasks.make import make
    from surgisoft.tasks.parallel import parallel_env

_PLACES = {
    "amend": "diagnosis.amend",
    "batched_env": "tasks.batched",
    "collect": "rig.trial",
    "compare": "diagnosis.compare",
    "demo": "demonstration.story",
    "diagnose": "diagnosis.diagnose",
    "evaluate": "agents.session",
    "fit": "measurement.fitting",
    "import_recordings": "measurement.importing",
    "improve": "diagnosis.improve",
    "load_model": "surrogate.checkpoint",
    "load_recording": "measurement.recordings",
    "load_recordings": "measurement.recordings",
    "make": "tasks.make",
    "next_experiment": "diagnosis.design.next_experiment",
    "open_replay": "replay.show",
    "open_scene": "scene.folder",
    "parallel_env": "tasks.parallel",
    "register_effect_file": "surrogate.effects",
    "run": "live.session",
    "save_model": "surrogate.checkpoint",
    "save_recording": "measurement.recordings",
    "train": "agents.training_request",
}
"""The module of each function, inside the package."""
_OTHER_NAMES = {"load": "load_model"}
"""Further names of functions."""

__all__ = [
    "__version__",
    "amend",
    "batched_env",
    "collect",
    "compare",
    "demo",
    "diagnose",
    "evaluate",
    "fit",
    "import_recordings",
    "improve",
    "load",
    "load_model",
    "load_recording",
    "load_recordings",
    "make",
    "next_experiment",
    "open_replay",
    "open_scene",
    "parallel_env",
    "register_effect_file",
    "run",
    "save_model",
    "save_recording",
    "train",
]


register_with_gymnasium()


def __getattr__(name: str) -> object:
    """Import a function when it is first asked for (PEP 562)."""
    present = _OTHER_NAMES.get(name, name)
    if present not in _PLACES:
        raise AttributeError(f"module 'surgisoft' has no attribute '{name}'")
    try:
        found = getattr(import_module(f"surgisoft.{_PLACES[present]}"), present)
    except ModuleNotFoundError as error:
        advice = missing_library(error, name)
        if advice is None:
            raise
        raise ImportError(f"surgisoft.{name}: {advice}", name=error.name) from None
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
