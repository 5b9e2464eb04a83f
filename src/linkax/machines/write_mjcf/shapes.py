"""Shapes of bodies in a model: geoms without mass and contact, which MuJoCo's viewer shows."""

from pathlib import Path

import numpy as np

from linkax.machines.write_mjcf.model import Model, add, at, words
from linkax.model.names import free_name
from linkax.model.shapes import Shape
from linkax.xla.users_line import warn

FORMATS = (".stl", ".obj")
STL_HEADER, STL_TRIANGLE = 84, 50  # bytes of a binary file, which has the number of triangles at the end of its header
MOST_TRIANGLES = 200_000  # that MuJoCo reads of an STL file


def write_shapes(model: Model) -> None:
    """Write the shapes of all bodies; one warning tells of the meshes that MuJoCo does not read."""
    drawn = {index: body.shape for index, body in enumerate(model.mechanism.bodies) if isinstance(body.shape, tuple)}
    paths = {shape.mesh: Path(shape.mesh).absolute() for each in drawn.values() for shape in each if shape.mesh}
    unread = {mesh: why for mesh, path in paths.items() if (why := _why_unread(path))}
    meshes = dict[tuple[str, str], str]()
    for index, shapes in drawn.items():
        for shape in shapes:
            if shape.mesh in unread:
                continue
            geom = {"type": shape.kind, **at(shape.pose)}
            if shape.mesh is None:
                geom["size"] = words(_halved(shape))
            else:
                geom["mesh"] = _mesh(model, str(paths[shape.mesh]), words(shape.size), meshes)
            if shape.colour is not None:
                geom["rgba"] = words(shape.colour)
            add(model.bodies[index], "geom", **geom, mass="0", contype="0", conaffinity="0")
    if unread:
        mesh, why = next(iter(unread.items()))
        more = f"; {len(unread) - 1} more" if len(unread) > 1 else ""
        warn(f"meshes are not in the MJCF: {str(mesh)!r} {why}{more}")


def _halved(shape: Shape) -> np.ndarray:
    """The size of a solid, as MuJoCo takes it: radii, and half of a box or a length."""
    size = np.array(shape.size)
    if shape.kind == "box":
        return size / 2.0
    return size * [1.0, 0.5] if shape.kind in ("cylinder", "capsule") else size


def _mesh(model: Model, path: str, scale: str, meshes: dict[tuple[str, str], str]) -> str:
    """The name of a mesh, which the model gets once for each scale.

    It is a shell, as MuJoCo refuses other meshes that enclose no volume, though no body has their inertia.
    """
    if (path, scale) not in meshes:
        name = free_name(Path(path).stem, {*meshes.values()})
        add(model.section("asset"), "mesh", name=name, file=path, scale=scale, inertia="shell")
        meshes[path, scale] = name
    return meshes[path, scale]


def _why_unread(path: Path) -> str:
    """Why MuJoCo would not read a mesh, and with it the whole text; "" where it does."""
    if path.suffix.lower() not in FORMATS:
        return "is neither STL nor OBJ; convert it"
    try:
        with path.open("rb") as file:
            header, size = file.read(STL_HEADER), path.stat().st_size
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    count = int.from_bytes(header[-4:], "little")
    if path.suffix.lower() == ".obj" or (count <= MOST_TRIANGLES and size == STL_HEADER + STL_TRIANGLE * count):
        return ""
    return f"is no binary STL of at most {MOST_TRIANGLES} triangles; convert it"
