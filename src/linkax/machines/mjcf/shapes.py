"""Shapes of MJCF: geoms as MuJoCo's viewer shows them."""

from pathlib import Path

import numpy as np

from linkax.machines.draft import Pose
from linkax.machines.mjcf.compiled import Compiled
from linkax.machines.poses import from_quaternion, inverse, pose
from linkax.machines.visuals import find_mesh
from linkax.machines.xml import Where

NO_COLOUR = np.array([0.5, 0.5, 0.5, 1.0], np.float32)  # of a geom that has none of its own


def read_shape(compiled: Compiled, index: int, body: str) -> None:
    """Read a geom as it is seen, in the colour that MuJoCo's own viewer gives it; what is not kept of it is noted."""
    model, where = compiled.model, compiled.where("geom", index)
    kind = compiled.mujoco.mjtGeom(int(model.geom_type[index])).name.removeprefix("mjGEOM_").lower()
    at = pose(model.geom_pos[index], from_quaternion(model.geom_quat[index]))
    colour, material = np.array(model.geom_rgba[index], dtype=float), int(model.geom_matid[index])
    if np.all(colour == NO_COLOUR):
        colour = np.array(model.mat_rgba[material], dtype=float) if material >= 0 else None
    x, y, z = map(float, model.geom_size[index])
    sizes = {
        "sphere": [x], "capsule": [x, 2.0 * y], "cylinder": [x, 2.0 * y], "ellipsoid": [x, y, z],
        "box": [2.0 * x, 2.0 * y, 2.0 * z],
    }  # fmt: skip
    try:
        if kind == "mesh":
            path, scale, in_geom = _mesh(compiled, int(model.geom_dataid[index]), where)
            compiled.draft.shape(body, kind, scale, at @ in_geom, path, colour)
        elif kind in sizes:
            compiled.draft.shape(body, kind, sizes[kind], at, None, colour)
        else:
            raise ValueError(f"a geom of type {kind!r} is not drawn")
    except ValueError as error:
        compiled.draft.leave_out(where, "geom", str(error), False)


def _mesh(compiled: Compiled, index: int, where: Where) -> tuple[Path, np.ndarray, Pose]:
    """The file of a mesh, its scale, and its pose in the geom, which MuJoCo has put at the centre of the mesh.

    **Raises:** `ValueError` for a mesh that is in no file, and one that its scale shears.
    """
    model, element = compiled.model, compiled.elements("mesh")[index]
    scale, back = np.array(model.mesh_scale[index]), from_quaternion(element.refquat).T
    address = int(model.mesh_pathadr[index])
    if address < 0 or (np.ptp(scale) and not np.allclose(back, np.eye(3))):
        raise ValueError("its mesh is in no file, or turned before it is scaled, and not drawn")
    file = Path(model.paths[address:].split(b"\0")[0].decode()).absolute()
    path = find_mesh(compiled.draft, str(file), where)
    centre = pose(model.mesh_pos[index], from_quaternion(model.mesh_quat[index]))
    return path, scale, inverse(centre) @ pose(-scale * (back @ element.refpos), back)
