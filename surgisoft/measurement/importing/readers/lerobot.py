"""LeRobotDataset folders (v3.0) as raw tables.

A frame is a row; a column is called FEATURE.NAME, such as `observation.state.p1_kPa`, and a feature
of one value like the feature, such as `timestamp`. Pictures are left out. `episode_index` is the
label of the run.
"""

from pathlib import Path

from surgisoft.measurement.importing.raw import FileRole, RawTable, Reader
from surgisoft.measurement.recordings.lerobot import LeRobotFrames, is_dataset


def _read(folder: Path, _: FileRole) -> RawTable:
    frames = LeRobotFrames.open(folder)
    return RawTable(folder, frames.names, frames)


READER = Reader("a LeRobotDataset", _read, fits=is_dataset, is_folder=True)
