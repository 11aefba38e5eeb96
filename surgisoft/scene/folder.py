"""An opened scene folder: the values of its file, the meshes in place, the ring on the organ."""

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import tomli_w

from surgisoft.config import read_toml, to_table
from surgisoft.errors import InputError
from surgisoft.scene.lesion import Ring, lesion_ring
from surgisoft.scene.mesh import Body, Mesh
from surgisoft.scene.meshio import read_mesh
from surgisoft.scene.spec import FILE, LesionSpec, SceneSpec, load_spec, spec_path


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene with its meshes in memory; world frame, mm."""

    spec: SceneSpec
    """The values of `scene.toml`."""
    folder: Path
    """Folder of the scene."""
    bodies: tuple[Body, ...]
    """Every body with its mesh and pose, in the file's order."""

    @property
    def organ(self) -> Body:
        """The body that carries the lesion."""
        return next(body for body in self.bodies if body.name == self.spec.lesion.body)

    @property
    def keep_out(self) -> dict[str, Mesh]:
        """Bodies that must not be touched, by name: their meshes in the world frame."""
        return {body.name: body.world_mesh for body in self.bodies if body.role == "keep-out"}

    @cached_property
    def ring(self) -> Ring:
        """The lesion's path, 72 points on the organ."""
        return self.ring_of()

    def ring_of(self, **count: int) -> Ring:
        """The lesion's path with `count` points; an InputError if it does not lie on the organ."""
        try:
            return lesion_ring(self.organ.world_mesh, self.spec.lesion, **count)
        except InputError as error:
            raise InputError(f"{self.folder / FILE}: {error}") from None

    def with_lesion(self, lesion: LesionSpec) -> "Scene":
        """A copy of the scene with another lesion on the same organ."""
        return replace(self, spec=replace(self.spec, lesion=lesion))

    @cached_property
    def content_hash(self) -> str:
        """sha256 in hex over the file's values and every mesh; comments do not count."""
        table = to_table(self.spec)
        for mount in table["mounts"]:
            if not mount["name"]:
                del mount["name"]  # scenes of before arms had names keep their hash
        if not table["contours"]:
            del table["contours"]
        digest = hashlib.sha256(tomli_w.dumps(table).encode())
        for body in self.bodies:
            digest.update(body.mesh.content_hash.encode())
        return digest.hexdigest()


def open_scene(path: str | Path) -> Scene:
    """Open a scene folder (or its scene.toml); an InputError names what is missing or bad.

    Meshes, mounts and lesion of a `Scene` are in mm in the world frame, whose z axis points up.
    """
    spec = load_spec(path)
    folder = spec_path(path).parent
    where, bodies = read_toml(spec_path(path))[1] / "bodies", []
    for i, body in enumerate(spec.bodies):
        if not (folder / body.mesh).is_file():
            raise (where / i / "mesh").error(
                f"there is no file '{body.mesh}'", "a mesh in the scene's folder"
            )
        bodies.append(Body(body.name, body.role, read_mesh(folder / body.mesh), body.pose()))
    return Scene(spec, folder, tuple(bodies))
