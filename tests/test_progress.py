"""Adapters of progress: what arrives at the caller."""

from surgisoft.progress import Stages, noted, text_only


def test_stages_share_one_scale_by_their_weights():
    calls = []
    stages = Stages(lambda done, total, note="": calls.append((done, total, note)), 10.0)
    first = stages.stage(4.0, "train")
    first(1, 2, "half")
    second = stages.stage(6.0, "evaluate")
    second(3, 4)
    second(0, 0)
    assert calls == [
        (0.0, 10.0, "train"),
        (2.0, 10.0, "train: half"),
        (4.0, 10.0, "evaluate"),
        (8.5, 10.0, "evaluate"),
        (4.0, 10.0, "evaluate"),
    ]


def test_notes_are_filled_in_and_texts_become_notes():
    calls = []

    def heard(done, total, note=""):
        calls.append((done, total, note))

    noted(heard, "rollout")(1, 3)
    noted(heard, "rollout")(2, 3, "own")
    text_only(heard)("fitting")
    assert calls == [(1, 3, "rollout"), (2, 3, "own"), (0.0, 0.0, "fitting")]
