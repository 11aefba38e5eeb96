"""Reads values out of an .rrd file, for comparing with what was meant to be in it."""

from rerun.chunk import RrdReader


def column(path, entity: str, component: str, timeline: str = "step") -> dict[int, list]:
    """Place on the timeline -> the component's values there; -1 for what holds at all times."""
    found = {}
    for chunk in RrdReader(path).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if component not in batch.schema.names:
            continue
        places = [-1] * chunk.num_rows
        if not chunk.is_static:
            places = batch.column(timeline).cast("int64").to_pylist()
        found |= dict(zip(places, batch.column(component).to_pylist(), strict=True))
    return found


def entities(path) -> set[str]:
    """Every entity of the recording."""
    return {str(chunk.entity_path) for chunk in RrdReader(path).stream()}


def values_of(path, entity: str) -> dict[str, list]:
    """Component or timeline -> the entity's values in order, without the clock of the computer."""
    found: dict[str, list] = {}
    for chunk in RrdReader(path).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name not in ("rerun.controls.RowId", "log_time", "log_tick"):
                found.setdefault(name, []).extend(batch.column(name).to_pylist())
    return found
