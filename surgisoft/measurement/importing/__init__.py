"""Import of a laboratory's files as recordings, by a map file (docs/recordings.md)."""

from surgisoft.measurement.importing.convert import (
    Imported,
    import_files,
    import_lerobot,
    import_log,
    import_recordings,
)
from surgisoft.measurement.importing.draft import MapDraft, draft_map, draft_of_map
from surgisoft.measurement.importing.raw import RawTable, Reader
from surgisoft.measurement.importing.readers import READERS
from surgisoft.measurement.importing.ready_maps import READY_MAPS
from surgisoft.measurement.importing.spec import ImportMap, load_map

__all__ = [
    "READERS",
    "READY_MAPS",
    "ImportMap",
    "Imported",
    "MapDraft",
    "RawTable",
    "Reader",
    "draft_map",
    "draft_of_map",
    "import_files",
    "import_lerobot",
    "import_log",
    "import_recordings",
    "load_map",
]
