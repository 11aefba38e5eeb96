"""Two real robots of other labs, imported with the shipped maps; skipped where absent."""

from pathlib import Path

import pytest

from surgisoft.cli import run

MAPS = Path(__file__).resolve().parents[2] / "docs" / "examples" / "maps"


def raw_folder(shared: Path, name: str) -> Path:
    """Folder of raw files, or the reason why a test cannot run."""
    folder = shared / "data" / name
    if not folder.is_dir():
        pytest.skip(f"recordings of {name} are not here")
    return folder


@pytest.fixture(scope="session")
def trunk(shared, tmp_path_factory):
    """Recordings of the trunk at 12.5 Hz by their payload, g."""
    folder, out = raw_folder(shared, "asl_trunk_payload"), tmp_path_factory.mktemp("trunk")
    (out / "map.toml").write_text((MAPS / "asl_trunk.toml").read_text() + "\n[rows]\nevery = 8\n")
    inputs, answer = folder / "control_inputs_controlled_1.csv", {}
    for payload, name in ((0, ""), (100, "_100g")):
        answer[payload] = out / f"trunk{payload}.parquet"
        files = [str(inputs), str(folder / f"observations_controlled_1{name}.csv")]
        arguments = ["import", *files, "--map", str(out / "map.toml"), "-o", str(answer[payload])]
        assert run(arguments) == 0
    return answer


@pytest.fixture(scope="session")
def two_segments(shared, tmp_path_factory):
    """The recording of the arm of two segments: the six runs of January, every 20th row.

    In the later ones the motion capture is slower than the log, and most positions repeat.
    """
    folder, out = raw_folder(shared, "asu_two_segment"), tmp_path_factory.mktemp("asu")
    files = [str(path) for path in sorted(folder.glob("Jan_*.txt.gz"))]
    assert len(files) == 6
    target, every = out / "arm.parquet", (MAPS / "asu_two_segment.toml").read_text()
    (out / "map.toml").write_text(every.replace("[rows]\n", "[rows]\nevery = 20\n"))
    assert run(["import", *files, "--map", str(out / "map.toml"), "-o", str(target)]) == 0
    return target
