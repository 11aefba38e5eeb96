"""Model folders: `config.json` and `weights.safetensors`. Opening one runs no code of it."""

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import asdict, replace
from importlib.resources import as_file, files
from pathlib import Path

import torch
from safetensors.torch import load_file
from safetensors.torch import save as safetensors_bytes
from torch import Tensor

from surgisoft import __version__
from surgisoft.config import Where, from_table, value_text
from surgisoft.errors import InputError, path_of, unknown_name, wrong_type
from surgisoft.files import new_folder, read_json, resolved
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.callables.arm import arm_by_itself
from surgisoft.surrogate.callables.named import (
    is_callable_name,
    name_callables,
    named_callable,
    stored_callable,
)
from surgisoft.surrogate.callables.network import CallableNetwork
from surgisoft.surrogate.callables.predicted import PredictedNetwork
from surgisoft.surrogate.effects import ArmFacts, Effect, effect_class, register_effect_files
from surgisoft.surrogate.effects.user_defined import check_files, files_of
from surgisoft.surrogate.fitted_rows import FittedRows
from surgisoft.surrogate.model import ArmModel, Validation, arm_facts
from surgisoft.surrogate.networks import (
    ConstantCurvature,
    HawEnsemble,
    HawNN,
    KernelArm,
    RecurrentArm,
)
from surgisoft.surrogate.training_residuals import FILE as RESIDUALS_FILE
from surgisoft.surrogate.training_residuals import TrainingResiduals

FORMAT = 1
"""Version of the folder's layout."""
LARGEST_CONFIG = 1_000_000
"""A larger `config.json` is not read, bytes."""
MOST_UNITS = 100_000
"""Most key points, members, arcs or units of a network that `config.json` may name."""

DEFAULT, DEFAULT_FOLDER = "default", Path(__file__).parents[1] / "assets" / "default_arm"
"""Name and folder of the arm that comes with the package."""

OWN_FILES = ("config.json", "weights.safetensors", "report.json", RESIDUALS_FILE)
"""Files of a model's folder. Replacing a model leaves all other files in place."""

NETWORKS = {
    "haw_nn": (HawNN, ("key_points", "hidden", "directions", "arcs")),
    "haw_ensemble": (HawEnsemble, ("key_points", "hidden", "directions", "members", "arcs")),
    "kernel": (KernelArm, ("key_points", "arcs", "landmarks", "times_s")),
    "constant_curvature": (ConstantCurvature, ("key_points", "sections")),
    "recurrent": (RecurrentArm, ("key_points", "width")),
    "callable": (CallableNetwork, ("key_points", "name", "sha256")),
}
"""Every network by name: its class and the arguments that build it again."""


SAME_MM = 0.01
"""Largest distance of a key point at rest, mm, between a saved callable model and the callable as
it is now: effects that were fitted around another callable do not belong to this one."""


def _network_config(network) -> dict:
    if isinstance(network, PredictedNetwork):
        raise InputError(
            f"{network.name}: predictions of recorded rows are not a model that could be saved; "
            "give the model as a callable (docs/your_model.md)"
        )
    if isinstance(network, CallableNetwork) and not network.named.found:
        raise InputError(
            f"{network.name}: no module has this object under a name, so a saved model could not "
            "be opened again; define it at the top of a module and import it from there"
        )
    for name, (kind, fields) in NETWORKS.items():
        if type(network) is kind:
            return {"kind": name, **{field: getattr(network, field) for field in fields}}
    raise TypeError(f"no checkpoint format for {type(network).__name__}")


def _validation_config(validation: Validation) -> dict:
    """JSON form of a validation, without interval, jumps and the values that are not known."""
    values = asdict(replace(validation, interval=None, jump_mm=None))
    known = {name: value for name, value in values.items() if value is not None}
    return known if validation.rmse_mm is not None else {}


def _interval(table: dict) -> dict:
    """The interval of a config; earlier versions had one growth for all key points."""
    growth, quantiles = table.get("growth"), table.get("quantiles_mm")
    if isinstance(growth, int | float) and isinstance(quantiles, list) and quantiles:
        return table | {"growth": [float(growth)] * len(quantiles[0])}
    return table


def _opened(
    folder: Path, name: str, facts: ArmFacts, arguments: dict, version: int | None
) -> Effect:
    """An effect of a file whose arguments and parameters were written by `version` of its class."""
    kind = effect_class(name)
    try:
        arguments = kind.migrated(arguments, version)
    except InputError as error:
        raise InputError(
            f"{folder}: effect '{name}' cannot be opened: {error}; fit or amend the model again"
        ) from error
    return kind(facts, **arguments)


def claim_folder(folder: str | Path, force: bool = False) -> Path:
    """Check that a folder can be written: free, or replaceable with `force`; changes nothing.

    Raises InputError where the folder is not writable, is in use, or holds something else than a
    model.
    """
    folder = path_of("the folder of the model", folder)
    above = next(parent for parent in resolved(folder).parents if parent.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise InputError(f"{folder}: cannot be written, {above} is not a writable folder")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file, expected a folder; choose another name")
    if folder.is_dir() and any(folder.iterdir()) and not _holds_model(folder):
        raise InputError(f"{folder}: holds files that are not a model; choose another name")
    if folder.is_dir() and any(folder.iterdir()) and not force:
        raise InputError(
            f"{folder}: already exists; choose another name or pass --force (in Python force=True)"
        )
    return folder


def _holds_model(folder: Path) -> bool:
    """Whether the `config.json` of a folder is that of an arm model, of any version, or a damaged
    file beside a model's weights."""
    try:
        config = read_json(folder / "config.json", LARGEST_CONFIG)
    except (InputError, OSError):
        files = ("config.json", "weights.safetensors")
        return all((folder / name).is_file() for name in files)
    return isinstance(config, dict) and {"arm", "network"} <= config.keys()


def save_model(
    model: ArmModel,
    folder: str | Path,
    report: dict | None = None,
    force: bool = False,
    known: TrainingResiduals | None = None,
) -> None:
    """Write a model to a folder, completely or not at all.

    report: JSON-able, stored beside the model; known: training residuals to store (default: those
    of the model). Raises InputError where the folder cannot be written (`claim_folder`, or a full
    disk).
    """
    if not isinstance(model, ArmModel):
        raise wrong_type("the model to save", model, "an ArmModel")
    known = model.training_residuals if known is None else known
    folder = claim_folder(folder, force)
    config = {
        "format": FORMAT,
        "surgisoft": __version__,
        "arm": asdict(model.spec),
        "network": _network_config(model.network),
        "effects": {name: effect.config() for name, effect in model.effects.items()},
        "effect_versions": {name: effect.version for name, effect in model.effects.items()},
        "effect_files": files_of(model.effects),
        "validation": _validation_config(model.validation),
    }
    if model.validation.interval is not None:
        # Beside the validation, where versions without intervals do not look.
        config["interval"] = model.validation.interval.to_json()
    if model.validation.jump_mm is not None:
        config["jump_mm"] = model.validation.jump_mm
    if model.fitted_rows is not None:
        config["fitted_rows"] = model.fitted_rows.to_json()
    try:
        with new_folder(folder, OWN_FILES) as fresh:
            weights = {name: value.contiguous().cpu() for name, value in model.state_dict().items()}
            # Not by `save_file`, which makes a file that only its owner can read.
            (fresh / "weights.safetensors").write_bytes(safetensors_bytes(weights))
            (fresh / "config.json").write_text(json.dumps(config, indent=2) + "\n")
            if report is not None:
                (fresh / "report.json").write_text(json.dumps(report, indent=2) + "\n")
            if known is not None:
                known.save(fresh)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror or error})") from error


def content_hash(model: ArmModel) -> str:
    """sha256 in hex over what a model predicts from: its arm, network, effects and weights."""
    config = {
        "arm": asdict(model.spec),
        "network": _network_config(model.network),
        "effects": {name: effect.config() for name, effect in model.effects.items()},
        "effect_files": [file["sha256"] for file in files_of(model.effects).values()],
    }
    digest = hashlib.sha256(json.dumps(config, sort_keys=True).encode())
    for name, value in sorted(model.state_dict().items()):
        digest.update(f"{name} {tuple(value.shape)} {value.dtype}\n".encode())
        digest.update(value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def _place(folder: str | Path) -> Path:
    """Folder of a model; for the name `default`, that of the embedded arm."""
    folder = path_of("the model", folder, "an ArmModel, or the path of one")
    return DEFAULT_FOLDER if str(folder) == DEFAULT and not folder.exists() else folder


def load_model(
    folder: str | Path | ArmModel,
    device: str | torch.device = "cpu",
    effect_files: Iterable[str | Path] = (),
    model_code: Iterable[str] = (),
) -> ArmModel:
    """The model in a folder, ready to evaluate; bit-equal to the saved one.

    `default`, where there is no such folder, is the arm that comes with the package. A model that
    is open already is returned as it is. `package.module:object`, `FILE.py:object` or an entry
    point names a callable model (docs/your_model.md), which then has to state its own range.

    effect_files: files of user-defined effects that the model may hold. They are run, so name only
    files that you trust. Raises InputError where the folder holds no model, a damaged one, or one
    that needs code that was not named. model_code: names of callables that the model may
    hold; they are imported, so name only what you trust.
    """
    register_effect_files(effect_files)
    name_callables(model_code)
    if isinstance(folder, ArmModel):
        return folder.to(device)
    folder = path_of("the model", folder, "an ArmModel, or the path of one")
    if is_callable_name(str(folder)):
        return arm_by_itself(named_callable(str(folder))).to(device)
    folder = _place(folder)
    absent = [n for n in ("config.json", "weights.safetensors") if not (folder / n).is_file()]
    if absent:
        raise InputError(
            f"{folder}: no arm model there ({absent[0]} is missing); expected 'default' or a "
            "folder that 'surgisoft fit' made"
        )
    file = folder / "config.json"
    try:
        config = read_json(file, LARGEST_CONFIG)
        weights = load_file(folder / "weights.safetensors")
        if config["format"] != FORMAT:
            raise InputError(
                f"{folder}: model format {value_text(config['format'])}, expected {FORMAT}; fit it "
                "again"
            )
        _check_finite(folder, weights)
        spec = from_table(ArmSpec, config["arm"], Where(file) / "arm")
        low, high = torch.tensor(spec.low), torch.tensor(spec.high)
        if weights["rest_mm"].shape != (spec.key_points, 3):
            raise InputError(
                f"{folder}: {spec.key_points} key points by config.json, 'rest_mm' has shape "
                f"{list(weights['rest_mm'].shape)} in the weights; fit the model again"
            )
        network = dict(config["network"])
        kind = network.pop("kind")
        if kind not in NETWORKS:
            raise unknown_name("network", str(kind), NETWORKS)
        if kind == "callable":
            code = (str(network["name"]), network.get("sha256"))
            network["named"] = stored_callable(*code, str(folder))
        else:
            _check_size(folder, NETWORKS[kind][0], low, high, network, weights)
        check_files(config.get("effect_files", {}), str(folder))
        facts = arm_facts(spec, weights["rest_mm"])
        versions = config.get("effect_versions", {})
        effects = {
            name: _opened(folder, name, facts, arguments, versions.get(name))
            for name, arguments in config["effects"].items()
        }
        stated = {"interval": _interval(config["interval"])} if config.get("interval") else {}
        stated |= {"jump_mm": config["jump_mm"]} if "jump_mm" in config else {}
        validation = from_table(Validation, config["validation"] | stated, Where(file))
        model = ArmModel(spec, NETWORKS[kind][0](low, high, **network), effects, None, validation)
        model.load_state_dict(weights)
        if "fitted_rows" in config:
            model.fitted_rows = FittedRows.from_json(config["fitted_rows"])
        _check_finite(folder, model.state_dict())
        if isinstance(model.network, CallableNetwork):
            _check_same_callable(model, str(folder))
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            f"{folder}: damaged model ({type(error).__name__}: {str(error)[:120]}); fit it again"
        ) from error
    model.training_residuals = load_training_residuals(folder)
    return model.to(device).eval().requires_grad_(False)


def _check_same_callable(model: ArmModel, label: str) -> None:
    """Raise InputError where a callable is not the one that effects were fitted around."""
    with torch.no_grad():
        now = model.network(model.rest[None], torch.zeros_like(model.rest)[None])[0]
    off = float((now - model.rest_mm).norm(dim=-1).max())
    if off > SAME_MM:
        raise InputError(
            f"{label}: {model.network.name} puts a key point at rest {off:.3g} mm from where it "
            "was when the effects were fitted; name the callable as it was, or amend it again"
        )


def _check_finite(folder: Path, weights: dict[str, Tensor]) -> None:
    """Raise InputError for weights that are NaN or infinite: such a model answers with NaN."""
    for name, value in weights.items():
        if value.is_floating_point() and not value.isfinite().all():
            bad = int((~value.isfinite()).sum())
            raise InputError(
                f"{folder}: {bad} of {value.numel()} numbers of '{name}' are NaN or infinite; "
                "fit the model again"
            )


def _check_size(
    folder: Path, network: type, low: Tensor, high: Tensor, arguments: dict, weights: dict
) -> None:
    """Raise InputError where the network that `config.json` names is not that of the weights.

    The network is laid out without memory for its numbers, so that a false size costs nothing.
    """
    numbers = [n for n in arguments.values() if isinstance(n, int)]
    layers = arguments.get("hidden", [])
    if max(numbers, default=0) > MOST_UNITS or len(layers) > len(weights):
        raise InputError(
            f"{folder}: the network of config.json is not that of the weights; fit the model again"
        )
    with torch.device("meta"):
        expected = network(low, high, **arguments).state_dict()
    found = {name.removeprefix("network."): value.shape for name, value in weights.items()}
    for name, value in expected.items():
        if found.get(name) != value.shape:
            raise InputError(
                f"{folder}: '{name}' has shape {list(found.get(name, ()))} in the weights and "
                f"{list(value.shape)} by config.json; fit the model again"
            )


def load_training_residuals(folder: str | Path) -> TrainingResiduals | None:
    """The training residuals in a model's folder; None where the folder has none."""
    try:
        return TrainingResiduals.load(_place(folder))
    except Exception as error:
        raise InputError(
            f"{folder}: damaged {RESIDUALS_FILE} ({type(error).__name__}: {str(error)[:120]}); "
            "fit the model again, or delete that file"
        ) from error


def default_arm(device: str | torch.device = "cpu") -> ArmModel:
    """The default arm: three chambers in kPa, five key points, hysteresis with memory."""
    with as_file(files("surgisoft") / "assets" / "default_arm") as folder:
        return load_model(folder, device)
