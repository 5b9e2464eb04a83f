"""What a body is drawn as, where that is not by its inertia or its joints."""

import dataclasses
import os
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from linkax.model.numbers import Constant, number, one_of, require, rotation_matrix, value
from linkax.xla.tracing import all_concrete, concrete

Kind = Literal["mesh", "box", "sphere", "cylinder", "capsule", "ellipsoid"]
SIZES = {"mesh": 3, "box": 3, "sphere": 1, "cylinder": 2, "capsule": 2, "ellipsoid": 3}  # numbers in each
NO_TURN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclasses.dataclass(frozen=True)
class Shape:
    """A solid or a mesh that a body is drawn as. It moves with the body, and has no mass and no contact.

    `lx.RigidBody(..., shape=[...])` takes it. It is structure, kept as tuples, compared by value, and no parameter.

    **Arguments:**

    - `kind`: "mesh", "box", "sphere", "cylinder", "capsule" or "ellipsoid". All but meshes are centred at the origin of
      the shape's frame.
    - `size`: [m]: of a box its extent along x, y, z; of a sphere its radius; of a cylinder along z its radius and
      length; of a capsule along z its radius and the length between the centres of its ends; of an ellipsoid its half
      axes. Of a mesh: how many metres one of its units is along x, y, z (default: 1).
    - `position`: of the origin of the shape's frame, in the body's reference frame [m], (3,).
    - `rotation`: the axes of the shape's frame as columns, in the body's axes, (3, 3).
    - `mesh`: path of the file of a mesh, STL or OBJ. It is read when it is drawn (`pip install "linkax[files]"`).
    - `colour`: red, green, blue and opacity, from 0 to 1, (4,); None: the colour of the body.

    **Raises:** `ValueError` for an unknown kind, another number of sizes, a length that is not positive, a mesh without
    a path, a rotation that is none, a colour out of range, and a number that is traced.
    """

    kind: Kind
    size: Any = (1.0, 1.0, 1.0)
    position: Any = (0.0, 0.0, 0.0)
    rotation: Any = NO_TURN
    mesh: str | os.PathLike[str] | None = None
    colour: Any = None

    def __post_init__(self) -> None:
        kind = one_of(self.kind, get_args(Kind), "kind of a shape")
        what = f"shape {kind!r}"
        if (self.mesh is None) == (kind == "mesh"):
            raise ValueError(f"{what}: mesh is {self.mesh!r}; give the path of a file to a 'mesh', and to it alone")
        for name in ("size", "position", "rotation", "colour"):
            if not all_concrete(getattr(self, name)):
                raise ValueError(f"{what}: {name} is traced; give numbers that are known, as a shape is structure")
        size = number([self.size] if np.ndim(self.size) == 0 else self.size, (SIZES[kind],), f"{what}: size [m]")
        fits = (lambda of: (of != 0.0).all()) if kind == "mesh" else (lambda of: (of > 0.0).all())
        found: dict[str, Any] = {
            "size": require(size, fits, f"{what}: size [m]", "lengths must be positive, and scales of a mesh not zero"),
            "position": number(self.position, (3,), f"{what}: position [m]"),
            "rotation": value(rotation_matrix(self.rotation, f"{what}: rotation")),
        }
        if self.colour is not None:
            given, between = number(self.colour, (4,), f"{what}: colour"), lambda of: ((of >= 0) & (of <= 1)).all()
            remedy = "red, green, blue and opacity must be from 0 to 1"
            found["colour"] = require(given, between, f"{what}: colour", remedy)
        for name, entry in found.items():
            object.__setattr__(self, name, Constant(np.asarray(entry)).entries)
        object.__setattr__(self, "mesh", None if self.mesh is None else os.fspath(self.mesh))

    @property
    def pose(self) -> Float[np.ndarray, "4 4"]:
        """The pose of the shape's frame on the body, as a homogeneous matrix [m]."""
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = np.array(self.rotation), np.array(self.position)
        return found


def turned(shapes: tuple[Shape, ...], rotation: Any) -> tuple[Shape, ...] | None:
    """The same shapes on a body whose axes turn by a rotation, (3, 3); None where that is traced."""
    turn = concrete(rotation)
    if turn is None:
        return None
    at = lambda shape: {"position": turn @ shape.pose[:3, 3], "rotation": turn @ shape.pose[:3, :3]}
    return tuple(dataclasses.replace(shape, **at(shape)) for shape in shapes)
