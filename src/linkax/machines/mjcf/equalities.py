"""Equalities of MJCF: joints that close loops, rods, and couplings of coordinates."""

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from linkax.machines.draft import Draft
from linkax.machines.mjcf.compiled import Compiled
from linkax.machines.mjcf.tendons import points_of, transmission
from linkax.machines.parts import Place
from linkax.machines.poses import exact, from_quaternion, pose, relative
from linkax.machines.xml import Where
from linkax.model.constraints.constraint import Coupling
from linkax.model.constraints.polynomial_coupling import PolynomialCoupling
from linkax.model.joints.distance import Distance
from linkax.model.joints.fixed import Fixed
from linkax.model.joints.revolute import Revolute
from linkax.model.joints.spherical import Spherical

SHORTEST = 1e-9  # apart from each other, two points of a pair of connects make an axis [m]
MOST_COEFFICIENTS = 5  # of polynomials of MuJoCo


class _Connect(NamedTuple):
    """A connect, with the places on both bodies that coincide."""

    name: str
    where: Where
    first: Place
    second: Place


def read_equalities(compiled: Compiled) -> None:
    """Read joints that close loops, rods, and couplings."""
    model, draft, kinds = compiled.model, compiled.draft, compiled.mujoco.mjtEq
    names = compiled.names("equality", [_between(compiled, index) for index in range(model.neq)])
    pairs = defaultdict[tuple[str, str], list[_Connect]](list)
    for index, name in enumerate(names):
        kind, where = kinds(int(model.eq_type[index])), compiled.where("equality", index)
        if not model.eq_active0[index]:
            draft.leave_out(where, "equality", "it is not active", False)
        elif kind in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            first, second = _ends(compiled, index, kind == kinds.mjEQ_WELD)
            if kind == kinds.mjEQ_CONNECT:
                pairs[first.body, second.body].append(_Connect(name, where, first, second))
            else:
                holds_turns = model.eq_data[index][10] != 0.0  # torquescale
                draft.joint_at(Fixed if holds_turns else Spherical, name, first, second, where, cut=True)
        elif kind == kinds.mjEQ_JOINT:
            _of_joints(compiled, index, name, where)
        elif kind == kinds.mjEQ_TENDON:
            _of_tendons(compiled, index, name, where)
        else:
            draft.leave_out(where, "equality", "an equality that is no connect, weld, joint or tendon")
    for connects in pairs.values():
        _close(draft, connects)


def _between(compiled: Compiled, index: int) -> str:
    """What to call an equality without a name: by what it is between."""
    element = compiled.elements("equality")[index]
    return "-".join(filter(None, (element.name1, element.name2)))


def _ends(compiled: Compiled, index: int, is_weld: bool) -> tuple[Place, Place]:
    """The places of an equality on its two bodies, which coincide where it holds."""
    model = compiled.model
    objects, data = (model.eq_obj1id[index], model.eq_obj2id[index]), np.array(model.eq_data[index])
    if compiled.mujoco.mjtObj(int(model.eq_objtype[index])) == compiled.mujoco.mjtObj.mjOBJ_SITE:
        on = [pose(model.site_pos[site], from_quaternion(model.site_quat[site])) for site in objects]
        first, second = (
            Place.at(compiled.body_names[model.site_bodyid[site]], at) for site, at in zip(objects, on, strict=True)
        )
        return first, second
    first, second = (compiled.body_names[body] for body in objects)
    if not is_weld:
        return Place(first, data[:3], np.eye(3)), Place(second, data[3:6], np.eye(3))
    turn = from_quaternion(data[6:10])  # of the second body, seen from the first; the anchor is on both
    return Place(first, data[3:6], turn), Place(second, data[:3], np.eye(3))


def _close(draft: Draft, connects: list[_Connect]) -> None:
    """Put balls at the points where two bodies are connected; two points make a hinge."""
    if len(connects) == 2:
        (name, where, first, second), (_, _, other, other_second) = connects
        axis = other.offset - first.offset
        if np.linalg.norm(axis) > SHORTEST:
            drawn = relative(draft.poses[first.body], draft.poses[second.body])[:3, :3]
            turn = _turn_between(drawn @ axis, other_second.offset - second.offset) @ drawn
            parent, child = Place(first.body, first.offset, np.eye(3)), Place(second.body, second.offset, turn)
            draft.joint_at(Revolute, name, parent, child, where, axis=axis, cut=True)
            return
    for name, where, first, second in connects:
        draft.joint_at(Spherical, name, first, second, where, cut=True)


def _turn_between(first: Float[np.ndarray, "3"], second: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The shortest rotation from one direction to another; two sites may be drawn where their loop is open."""
    from scipy.spatial.transform import Rotation

    across = np.cross(first, second)
    angle, size = np.arctan2(np.linalg.norm(across), first @ second), np.linalg.norm(across)
    if size == 0.0 and angle > 0.0:  # opposite: half a turn about any axis across
        across = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
        size = np.linalg.norm(across)
    return exact(Rotation.from_rotvec(across * (angle / size)).as_matrix()) if size else np.eye(3)


def _of_joints(compiled: Compiled, index: int, name: str, where: Where) -> None:
    """Couple one coordinate to another one, or hold it."""
    objects = int(compiled.model.eq_obj1id[index]), int(compiled.model.eq_obj2id[index])
    follower, leader = ({compiled.joint_names[joint]: 1.0} if joint >= 0 else {} for joint in objects)
    _couple(compiled, index, name, where, follower, leader)


def _of_tendons(compiled: Compiled, index: int, name: str, where: Where) -> None:
    """Hold the length of a straight tendon, as a rod does, or couple linear combinations of coordinates."""
    model, objects = compiled.model, (int(compiled.model.eq_obj1id[index]), int(compiled.model.eq_obj2id[index]))
    constant, *others = map(float, model.eq_data[index][:MOST_COEFFICIENTS])
    points = points_of(compiled, objects[0])
    if points and (objects[1] < 0 or not any(others)):
        length = float(model.tendon_length0[objects[0]]) + constant
        compiled.draft.joint_at(Distance, name, *points, where, length=length)
        return
    follower, leader = (transmission(compiled, tendon, where) if tendon >= 0 else {} for tendon in objects)
    if follower is not None and leader is not None:
        _couple(compiled, index, name, where, follower, leader)


def _couple(
    compiled: Compiled, index: int, name: str, where: Where, follower: dict[str, float], leader: dict[str, float]
) -> None:
    """y = a₀ + a₁ x + … of coordinates, or lengths, measured from where the machine is drawn."""
    coefficients = np.array(compiled.model.eq_data[index][:MOST_COEFFICIENTS])
    if np.any(coefficients[2:]) and leader:
        arguments = {"joint": follower, "of": leader, "coefficients": coefficients}
        compiled.draft.constraint(PolynomialCoupling, name, where, **arguments)
        return
    terms = dict(follower)
    for joint, factor in leader.items():
        terms[joint] = terms.get(joint, 0.0) - coefficients[1] * factor
    terms = {joint: float(factor) for joint, factor in terms.items() if factor}
    compiled.draft.constraint(Coupling, name, where, coefficients=terms, offset=float(coefficients[0]))
