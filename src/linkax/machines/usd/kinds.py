"""Which joint of linkax a joint of a stage is: by its type, or by the axes that its limits lock."""

from typing import Any

import numpy as np
from jaxtyping import Float

from linkax.machines.usd.stage import AXES, Stage
from linkax.model.joints.cylindrical import Cylindrical
from linkax.model.joints.fixed import Fixed
from linkax.model.joints.free import Free
from linkax.model.joints.planar import Planar
from linkax.model.joints.prismatic import Prismatic
from linkax.model.joints.rectangular import Rectangular
from linkax.model.joints.revolute import Revolute
from linkax.model.joints.spherical import Spherical
from linkax.model.joints.universal import Universal

KINDS = {
    "PhysicsRevoluteJoint": Revolute, "PhysicsPrismaticJoint": Prismatic, "PhysicsSphericalJoint": Spherical,
    "PhysicsFixedJoint": Fixed,
}  # fmt: skip
NO_LIMIT = 1e30  # largest numbers of single precision stand for infinity


def kind_of(stage: Stage, prim: Any) -> tuple[Any, Any, dict[str, int]]:
    """The class of a joint, its h¹, h² and h³ in the frame of the file, and its coordinates by USD's names.

    The axes are None where those of the file serve; the class is None where no joint moves along these axes.
    """
    if prim.GetTypeName() in KINDS:
        kind = KINDS[prim.GetTypeName()]
        if kind in (Revolute, Prismatic):
            token = "angular" if kind is Revolute else "linear"
            return kind, _cyclic(stage.axis(prim, "physics:axis", "X")), {token: 0}
        return kind, None, {}
    free = {way: [axis for axis in range(3) if not _locks(stage, prim, way + AXES[axis])] for way in ("trans", "rot")}
    slides, turns = free["trans"], free["rot"]
    match slides, turns:
        case [], []:
            return Fixed, None, {}
        case [], [axis]:
            return Revolute, _cyclic(axis), {f"rot{AXES[axis]}": 0}
        case [], [first, second]:
            axes = np.eye(3)[[first, second]]
            names = {f"rot{AXES[first]}": 0, f"rot{AXES[second]}": 1}
            return Universal, np.column_stack([*axes, np.cross(*axes)]), names
        case [], _:
            return Spherical, None, {f"rot{axis}": index for index, axis in enumerate(AXES)}
        case [axis], []:
            return Prismatic, _cyclic(axis), {f"trans{AXES[axis]}": 0}
        case [axis], [other] if axis == other:
            return Cylindrical, _cyclic(axis), {f"rot{AXES[axis]}": 0, f"trans{AXES[axis]}": 1}
        case [_, _], [] | [_]:
            (across,) = {0, 1, 2} - set(slides)
            second, third = (f"trans{AXES[(across + step) % 3]}" for step in (1, 2))
            if not turns:
                return Rectangular, _cyclic(across), {second: 0, third: 1}
            if turns == [across]:
                return Planar, _cyclic(across), {f"rot{AXES[across]}": 0, second: 1, third: 2}
        case [_, _, _], [_, _, _]:
            names = [way + axis for way in ("rot", "trans") for axis in AXES]
            return Free, None, {name: index for index, name in enumerate(names)}
    return None, None, {way + AXES[axis]: 0 for way, axes in free.items() for axis in axes}


def range_of(stage: Stage, prim: Any, token: str) -> tuple[float, float]:
    """The ends of the range of a coordinate, by USD's name of it [degrees or units of the stage]."""
    names = ("physics:lowerLimit", "physics:upperLimit")
    if token not in ("angular", "linear"):
        names = (f"limit:{token}:physics:low", f"limit:{token}:physics:high")
    ends = np.array([stage.number(prim, names[0], -np.inf), stage.number(prim, names[1], np.inf)])
    lower, upper = np.where(np.abs(ends) < NO_LIMIT, ends, np.copysign(np.inf, ends)).tolist()
    return lower, upper


def _locks(stage: Stage, prim: Any, token: str) -> bool:
    lower, upper = range_of(stage, prim, token)
    return lower > upper or lower == upper == 0.0


def _cyclic(axis: int) -> Float[np.ndarray, "3 3"]:
    """Axes that begin with one of x, y and z, as columns."""
    return np.eye(3)[:, [axis, (axis + 1) % 3, (axis + 2) % 3]]
