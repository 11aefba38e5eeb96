"""The fuzzer: it sees what it looks for, its inputs can be made again, and the corpus is read."""

import json
import os
import random
import signal
import time

import numpy as np
import pytest
import torch

from benchmarks.fuzz import targets
from benchmarks.fuzz.mutations import KINDS, change_tree, mutated
from benchmarks.fuzz.run import Batch, Inputs, Limits, examine, make_corpus, turns_of
from surgisoft.errors import InputError
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model
from surgisoft.surrogate.effects import EFFECTS


def raising(error):
    def read(_):
        raise error

    return read


def hungry(_):
    np.ones(1 << 28)


def endless(_):
    while True:
        time.monotonic()


def killed(_):
    os.kill(os.getpid(), signal.SIGKILL)


READERS = {
    "value": (lambda _: None, None),
    "line": (raising(InputError("a: is bad; expected good")), None),
    "system": (raising(FileNotFoundError(2, "no such file", "a")), None),
    "traceback": (raising(KeyError("x")), "traceback"),
    "exit": (raising(SystemExit(0)), "traceback"),
    "swallowed": (raising(InputError("a: MemoryError")), "memory"),
    "memory": (hungry, "memory"),
    "hang": (endless, "hang"),
    "crash": (killed, "crash"),
}


@pytest.mark.parametrize("name", READERS)
def test_a_worker_sees(name, tmp_path, monkeypatch):
    """Each bad end of a reader is one kind of finding; a value and one line are none."""
    read, kind = READERS[name]
    if name == "swallowed":
        read.__closure__[0].cell_contents.__cause__ = MemoryError()
    calls = []

    def read_mutated(sample):
        calls.append(sample)
        if (sample / "a.bin").read_bytes() != b"valid":
            read(sample)

    monkeypatch.setitem(targets.TARGETS, name, targets.Target(lambda _: None, read_mutated))
    (tmp_path / "corpus" / "one").mkdir(parents=True)
    (tmp_path / "corpus" / "one" / "a.bin").write_bytes(b"valid")
    limits = Limits(hang_s=0.2, memory_bytes=1 << 29, batch_s=0.05)
    batch = Batch(name, 0, 0, tmp_path / "corpus", tmp_path, limits, time.monotonic() + 60)
    batch.start()
    while (record := batch.finished()) is None:
        time.sleep(0.01)
    assert record["inputs"] >= 1
    assert {finding["kind"] for finding in record["findings"]} == ({kind} if kind else set())


def test_a_message_of_more_than_one_line_is_found(tmp_path, monkeypatch):
    error = InputError("a")
    error.args = ("two\nlines",)
    monkeypatch.setitem(targets.TARGETS, "x", targets.Target(lambda _: None, raising(error)))
    assert examine("x", 0, tmp_path, Limits())["kind"] == "message"


def test_inputs_are_the_same_for_the_same_seed_and_samples_stay_whole(tmp_path):
    make_corpus(tmp_path / "corpus", "schedule")
    target, seen = targets.TARGETS["schedule"], []
    for work in ("a", "b"):
        inputs = Inputs(target, tmp_path / "corpus" / "schedule", tmp_path / work, 3)
        whole = (inputs.samples[0][0] / "schedule.csv").read_bytes()
        for number in range(40):
            with inputs.put(number) as sample:
                seen.append((sample / "schedule.csv").read_bytes())
            assert (sample / "schedule.csv").read_bytes() == whole
    assert seen[:40] == seen[40:]
    assert len(set(seen)) > 30


def test_mutations_of_json_stay_json_and_reach_every_node():
    table, changed = {"a": {"b": [1, {"c": 2}]}, "d": "x"}, set()
    for seed in range(3000):
        found = change_tree(random.Random(seed), table)
        changed.add(json.dumps(found, default=str))
    assert json.dumps(table) == '{"a": {"b": [1, {"c": 2}]}, "d": "x"}'
    assert len(changed) > 100
    assert any('{"b": [1, {"c": null}]}' in text for text in changed)


def test_a_mutation_that_cannot_be_made_is_one_of_bytes():
    for suffix in KINDS:
        for seed in range(20):
            assert isinstance(mutated(random.Random(seed), f"a.{suffix}", b"broken"), bytes)


def test_targets_take_turns_by_weight():
    turns = turns_of(["recording", "scene"])
    assert [next(turns) for _ in range(8)].count("recording") == 6


def test_the_sample_with_all_effects_bends_otherwise_and_is_read(tmp_path):
    plain = default_arm().replace(effects={})
    effects = targets.with_all_effects(plain)
    assert set(effects.effects) == set(EFFECTS)
    save_model(effects, tmp_path)
    targets.read_model(tmp_path)
    ends = []
    for model in (plain, load_model(tmp_path)):
        with torch.inference_mode():
            ends.append(model.step(model.initial_state(batch=1), torch.ones(1, 3), dt=0.05)[1])
    assert (ends[0] - ends[1]).abs().max() > 0.01
