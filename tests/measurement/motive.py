"""A file as OptiTrack Motive exports it, of an arm whose true shape is known."""

import numpy as np
from scipy.spatial.transform import Rotation

RADIUS_MM = 7.5
"""Radius of the circle that a plane's markers stand on [mm]."""


def arm(t, planes=4, length_mm=70.0):
    """Centres (T, n, 3) [mm] and normals (T, n, 3) of the planes of an arc that bends in time.

    A circular arc of constant length in the plane of x and z: closed form of x(s), z(s).
    """
    s = np.linspace(0, length_mm, planes)
    angle = (0.9 * np.sin(0.7 * t) + 1e-3)[:, None] * s / length_mm
    radius = s / np.where(s == 0, 1, angle)
    x, z = radius * (1 - np.cos(angle)), radius * np.sin(angle)
    centres = np.stack([x, 0 * x, np.where(s == 0, 0, z)], axis=2)
    normals = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=2)
    return centres, normals


def markers_on(centres, normals, count=3, turn=0.4):
    """Markers (T, n, k, 3) [mm] on circles around the planes' centres."""
    y = np.array([0.0, 1.0, 0.0])
    x = np.cross(y, normals)
    angles = turn + 2 * np.pi * np.arange(count) / count
    return centres[:, :, None] + RADIUS_MM * (
        np.cos(angles)[:, None] * x[:, :, None] + np.sin(angles)[:, None] * y
    )


def to_room(points_mm, mount):
    """From the arm's base frame [mm] to Motive's room [mm]; mount = (rotation, position [mm])."""
    rotation, position = mount
    return points_mm @ rotation.T + position


MOUNT = (
    Rotation.from_euler("xyz", [75, 20, -30], degrees=True).as_matrix(),
    np.array([120.0, 850.0, -40.0]),
)
"""Pose of the arm's base in a room whose y points up."""


def export(
    t,
    markers_mm,
    *,
    version="1.23",
    unit="Meters",
    bodies=True,
    solved=True,
    lost=(),
    digits=9,
    names="Plane{}",
    euler=False,
):
    """Text of the export: markers (T, n, k, 3) [mm] in the room; `lost` are (row, plane, marker).

    Versions before 1.23 have no labels in front of the header's lines, from 1.25 there is a line of
    parents, as in Motive's own files.
    """
    scale = {"Meters": 1e-3, "Centimeters": 0.1, "Millimeters": 1.0}[unit]
    samples, planes, count = markers_mm.shape[:3]
    columns = []  # type, name, property, axis, values
    hidden = np.zeros(markers_mm.shape[:3], bool)
    for index in lost:
        hidden[index] = True
    for plane in range(planes):
        name = names.format(plane)
        if bodies:
            pose = np.array([0.1, -0.2, 0.3, np.sqrt(1 - 0.14)])
            for axis, value in zip("XYZ" if euler else "XYZW", pose, strict=False):
                columns.append(("Rigid Body", name, "Rotation", axis, np.full(samples, value)))
            pivot = markers_mm[:, plane].mean(axis=1) * scale
            for i, axis in enumerate("XYZ"):
                columns.append(("Rigid Body", name, "Position", axis, pivot[:, i]))
            columns.append(("Rigid Body", name, "Mean Marker Error", "", np.full(samples, 2e-4)))
        for kind in ["Rigid Body Marker"] * solved + ["Marker"]:
            for marker in range(count):
                values = markers_mm[:, plane, marker] * scale
                if kind == "Marker":
                    values = np.where(hidden[:, plane, marker, None], np.nan, values)
                else:
                    values = values + 5 * scale  # solved positions are not the measured ones
                for i, axis in enumerate("XYZ"):
                    label = f"{name}:Marker{marker + 1}"
                    columns.append((kind, label, "Position", axis, values[:, i]))
    columns.append(("Marker", "Unlabeled 1189", "Position", "X", np.full(samples, np.nan)))
    return _text(t, columns, version, unit, digits, "XYZ" if euler else "Quaternion")


def _text(t, columns, version, unit, digits, rotation):
    labelled = version >= "1.23"

    def line(label, values):
        return ",".join(["", label if labelled else "", *values])

    head = [
        f"Format Version,{version},Take Name,Take 2024-05-01 12.00.00 PM,Capture Frame Rate,"
        f"120.000000,Export Frame Rate,120.000000,Capture Start Time,2024-05-01 12.00.00.000 PM,"
        f"Total Frames in Take,{len(t)},Total Exported Frames,{len(t)},Rotation Type,{rotation},"
        f"Length Units,{unit},Coordinate Space,Global",
        "",
        line("Type", [c[0] for c in columns]),
        line("Name", [f'"{c[1]}"' for c in columns]),
        line("ID", [f'"{i:032X}"' for i in range(len(columns))]),
        *([line("Parent", ["" for _ in columns])] if version >= "1.25" else []),
        line("", [c[2] for c in columns]),
        ",".join(["Frame", "Time (Seconds)" if labelled else "Time", *[c[3] for c in columns]]),
    ]
    values = np.column_stack([c[4] for c in columns])
    rows = [
        f"{i},{t[i]:.6f}," + ",".join("" if np.isnan(v) else f"{v:.{digits}f}" for v in row)
        for i, row in enumerate(values)
    ]
    return "\n".join([*head, *rows, ""])
