"""Describe the shapes of bodies for a page: solids of size one, and meshes, each with its matrix on the body."""

from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.model.mechanism import Mechanism
from linkax.model.shapes import Shape
from linkax.scenery.scenery import Scenery
from linkax.view.meshes import Mesh, read_meshes

FORMS = {
    "mesh": "mesh", "box": "cube", "sphere": "ball", "ellipsoid": "ball", "cylinder": "cylinder", "capsule": "cylinder",
}  # fmt: skip
WHOLE = 65535  # steps along a side of a mesh's box
CORNERS = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3), axis=-1).reshape(-1, 3)


class Meshes:
    """Meshes as whole numbers in one array: places along the sides of the box of a mesh, and indices of corners.

    - `index`: {path: which mesh it is}.
    - `described`: of each its box, and where its numbers are, as [where they start, how many there are].
    """

    def __init__(self, read: dict[str, Mesh]) -> None:
        self.index = {path: index for index, path in enumerate(read)}
        self.described: list[dict[str, Any]] = []
        self._parts = [np.zeros(0)]
        start = 0
        for points, triangles in read.values():
            low, size = points.min(axis=0), np.ptp(points, axis=0)
            self._parts += [np.round((points - low) / np.where(size > 0.0, size, 1.0) * WHOLE), triangles]
            between, end = start + points.size, start + points.size + triangles.size
            ranges = {"points": [start, points.size], "corners": [between, triangles.size]}
            self.described.append({"low": low.tolist(), "size": size.tolist(), **ranges})
            start = end

    def bytes(self) -> bytes:
        """All whole numbers, little endian."""
        return np.concatenate([part.reshape(-1) for part in self._parts]).astype("<u4").tobytes()


def shapes_of(mechanism: Mechanism) -> tuple[dict[str, list[Shape]], dict[str, Mesh]]:
    """The shapes of the bodies that have some, {body: shapes}, without meshes that cannot be read; meshes by path."""
    shapes = {body.name: body.shape for body in mechanism.bodies if isinstance(body.shape, tuple)}
    read = read_meshes([str(shape.mesh) for each in shapes.values() for shape in each if shape.mesh])
    drawn = lambda shape: shape.kind != "mesh" or shape.mesh in read
    return {name: list(filter(drawn, each)) for name, each in shapes.items()}, read


def solids_of(mechanism: Mechanism) -> tuple[dict[str, list[dict[str, Any]]], Meshes]:
    """The solids of the bodies that have shapes, {body: solids}, and their meshes."""
    shapes, read = shapes_of(mechanism)
    meshes = Meshes(read)
    return {name: [part for shape in each for part in _solids(shape, meshes)] for name, each in shapes.items()}, meshes


def _solids(shape: Shape, meshes: Meshes) -> list[dict[str, Any]]:
    """What a shape is drawn by."""
    size, at = np.array(shape.size), shape.pose
    if FORMS[shape.kind] == "cylinder":
        extent = np.array([2.0 * size[0], 2.0 * size[0], size[1]])
    else:
        extent = size if shape.kind in ("mesh", "box") else 2.0 * size * np.ones(3)
    pieces = [(FORMS[shape.kind], extent, 0.0)]
    if shape.kind == "capsule":
        pieces += [("ball", np.full(3, 2.0 * size[0]), end * size[1]) for end in (-0.5, 0.5)]
    *rgb, opacity = shape.colour or (1.0,)
    described = {
        "kind": "solid",
        "colour": "#" + "".join(f"{round(255 * part):02x}" for part in rgb) if rgb else None,
        "opacity": opacity,
        "mesh": meshes.index.get(str(shape.mesh)),
    }
    return [described | {"form": form, "matrix": _matrix(at, extent, along)} for form, extent, along in pieces]


def _matrix(at, extent, along) -> list[list[float]]:
    """A pose whose axes have lengths, moved along its z axis."""
    matrix = at.copy()
    matrix[:3, 3] += at[:3, 2] * along
    matrix[:3, :3] *= extent
    return matrix.tolist()


def space(scenery: Scenery, solids: dict[str, list[dict[str, Any]]], meshes: Meshes) -> Float[np.ndarray, "2 3"]:
    """Lowest and highest corner of all that is drawn at any time, with the boxes of the solids [m]."""
    low, high = scenery.space
    for name, parts in solids.items():
        origin, axes = scenery.poses[name]
        for part in parts:
            box = {"low": [-0.5] * 3, "size": [1.0] * 3} if part["mesh"] is None else meshes.described[part["mesh"]]
            matrix = np.array(part["matrix"])
            on_body = (box["low"] + CORNERS * box["size"]) @ matrix[:3, :3].T + matrix[:3, 3]
            placed = origin[:, None] + on_body @ np.swapaxes(axes, 1, 2)
            low, high = np.minimum(low, placed.min(axis=(0, 1))), np.maximum(high, placed.max(axis=(0, 1)))
    return np.stack([low, high])
