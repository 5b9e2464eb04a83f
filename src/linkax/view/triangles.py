"""Solids as meshes of triangles, on their bodies [m]."""

from functools import cache

import numpy as np
from jaxtyping import Float, Int

from linkax.model.shapes import Shape
from linkax.spatial.rotations import frame_about_axis
from linkax.view.meshes import Mesh
from linkax.view.solids import CORNERS

AROUND = 24  # points around a ball or cylinder, a multiple of four


def mesh_of(shape: Shape, read: dict[str, Mesh] | None = None) -> Mesh:
    """The mesh of a shape; `read` has those of files."""
    size, at = np.array(shape.size), shape.pose
    if read and shape.kind == "mesh":
        points, triangles = read[str(shape.mesh)]
        points, triangles = points * size, triangles[:, :: int(np.sign(np.prod(size)))]
    else:
        wide, long, triangles = _form(shape.kind)
        is_long = shape.kind in ("cylinder", "capsule")
        points = wide * size[0] + long * size[1] if is_long else wide * size
    return Mesh(points @ at[:3, :3].T + at[:3, 3], triangles)


def rod(begin: Float[np.ndarray, "3"], end: Float[np.ndarray, "3"], radius: float) -> Mesh:
    """A rod with round ends about two points."""
    length = float(np.linalg.norm(end - begin))
    axes = np.roll(frame_about_axis((end - begin) / length), -1, axis=1)  # the third one is along the rod
    return mesh_of(Shape("capsule", [radius, length], (begin + end) / 2.0, axes))


def hull(points: Float[np.ndarray, "n 3"]) -> Mesh:
    """The convex hull of points, its triangles counter-clockwise from outside."""
    from scipy.spatial import ConvexHull  # takes its time to import

    found = ConvexHull(points)
    triangles = found.simplices.astype(int)
    inwards = np.sum(normals_of(Mesh(points, triangles)) * found.equations[:, :3], axis=1) < 0.0
    return Mesh(points, np.where(inwards[:, None], triangles[:, ::-1], triangles))


def normals_of(mesh: Mesh) -> Float[np.ndarray, "m 3"]:
    """Unit vectors at right angles to triangles, which are counter-clockwise from there; zero without an area."""
    first, second, third = np.moveaxis(mesh.points[mesh.triangles], 1, 0)
    across = np.cross(second - first, third - first)
    lengths = np.linalg.norm(across, axis=1, keepdims=True)
    return across / np.where(lengths > 0.0, lengths, 1.0)


@cache
def _form(kind: str) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Int[np.ndarray, "m 3"]]:
    """Points of a solid, with a radius or extents of one, what a length of one adds to them, and the triangles."""
    step, up = 2.0 * np.pi / AROUND, np.array([0.0, 0.0, 1.0])
    latitude, longitude = step * np.mgrid[1 - AROUND // 4 : AROUND // 4, 0:AROUND].reshape(2, -1)
    level = np.cos(latitude) * np.stack([np.cos(longitude), np.sin(longitude), np.tan(latitude)])
    ball = np.concatenate([level.T, [up, -up]])
    parts = {"box": CORNERS - 0.5, "cylinder": ball[ball[:, 2] == 0.0], "capsule": ball[ball[:, 2] >= 0.0]}
    wide = parts.get(kind, ball)
    long = np.zeros_like(wide)
    if kind in ("cylinder", "capsule"):
        wide, long = np.concatenate([wide, -wide]), np.concatenate([long + up / 2.0, long - up / 2.0])
    return wide, long, hull(wide + long).triangles
