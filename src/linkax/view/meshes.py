"""Read the meshes that bodies are drawn as, and make them small enough for a page."""

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from linkax.machines.xml import read_file
from linkax.optional import needed
from linkax.xla.users_line import warn

FORMATS = ("stl", "obj", "dae")
MORE = {"dae": ", or pip install pycollada networkx"}  # what trimesh needs for a format
MOST_TRIANGLES = 50_000  # of a mesh in a page; of larger ones, points that are near to each other become one
FINEST = 1024  # places along the longest side of a mesh that is made smaller


class Mesh(NamedTuple):
    """Points, in the units of the file, (n, 3), and triangles as indices of their corners, (m, 3)."""

    points: Float[np.ndarray, "n 3"]
    triangles: Int[np.ndarray, "m 3"]


def read_meshes(paths: list[str]) -> dict[str, Mesh]:
    """Read files of meshes, each once; one warning tells of those that cannot be read."""
    found: dict[str, Mesh] = {}
    failed: dict[str, str] = {}
    for path in dict.fromkeys(paths):
        try:
            found[path] = smaller(_read(Path(path)))
        except Exception as error:  # of a reader that meets a file of any content
            failed[path] = f"{Path(path).name}: {' '.join(str(error).split())[:200]}"
    if failed:
        more = f"; {len(failed) - 1} more" if len(failed) > 1 else ""
        warn(f"meshes are not drawn, {next(iter(failed.values()))}{more}", UserWarning)
    return found


def _read(path: Path) -> Mesh:
    trimesh = needed("trimesh", "trimesh reads it", "files")
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS or kind not in trimesh.available_formats():
        raise ValueError(f"a mesh of format {kind!r} is not read; convert it to STL or OBJ{MORE.get(kind, '')}")
    read = trimesh.load_mesh(io.BytesIO(read_file(path)), file_type=kind)  # without the path no other file is read
    points, triangles = np.asarray(read.vertices, float), np.asarray(read.faces, int)
    if not len(triangles) or not np.all(np.isfinite(points)):
        raise ValueError("it has no triangle, or a point that is not finite")
    return Mesh(points, triangles)


def smaller(mesh: Mesh, most: int = MOST_TRIANGLES) -> Mesh:
    """A mesh of no more triangles than `most`: points in one cell of a grid become their mean."""
    finest, made = FINEST, mesh
    while len(made.triangles) > most:
        low, size = mesh.points.min(axis=0), np.ptp(mesh.points, axis=0).max() or 1.0
        cells = np.floor((mesh.points - low) / size * finest).astype(int)
        _, of, counts = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        of = of.reshape(-1)
        means = np.stack([np.bincount(of, mesh.points[:, axis]) / counts for axis in range(3)], axis=1)
        corners = of[mesh.triangles]
        apart = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
        made, finest = Mesh(means, corners[apart]), finest * 3 // 4
    return made
