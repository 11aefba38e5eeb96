"""Parquet files as raw tables."""

from pathlib import Path

from surgisoft.measurement.importing.raw import FileRole, RawTable, Reader
from surgisoft.measurement.tables import ParquetTable


def _read(path: Path, _: FileRole) -> RawTable:
    table = ParquetTable.open(path)
    return RawTable(path, table.names, table)


READER = Reader("a Parquet file", _read, suffixes=(".parquet",))
