"""Loops of a model, which equalities between sites close: connects, welds, and tendons of fixed length."""

from typing import Any

import numpy as np

from linkax.machines.poses import pose
from linkax.machines.write_mjcf.model import Model, polynomial, refused
from linkax.machines.write_mjcf.pieces import ends_of, pose_of
from linkax.model.joints.distance import Distance
from linkax.model.joints.fixed import Fixed
from linkax.model.joints.free import Free
from linkax.model.joints.revolute import Revolute
from linkax.model.joints.spherical import Spherical

CLOSES = (Revolute, Spherical, Fixed, Distance)  # joints that MuJoCo has an equality for


def write_cut(model: Model, joint: Any) -> None:
    """Write a cut joint.

    **Raises:** `ValueError` for a joint that MuJoCo has no equality for, which says what to cut in its place.
    """
    name = joint.name
    if isinstance(joint, Free):
        return
    if type(joint) not in CLOSES:
        raise refused(joint, f"MuJoCo closes no loop by a {type(joint).__name__}; {_instead(model, name)}")
    ends = {"parent": joint.parent, "child": joint.child}
    sites = [model.site_at(f"{name}.{end}", frame, type(joint) is Fixed) for end, frame in ends.items()]
    if isinstance(joint, Distance):
        extra = joint.length - _drawn_apart(model, *ends.values())
        model.equality("tendon", name, tendon1=model.spatial(name, sites), polycoef=polynomial(extra))
        return
    model.equality("weld" if type(joint) is Fixed else "connect", name, site1=sites[0], site2=sites[1])
    if type(joint) is Revolute:
        _connect_again(model, joint, name, ends)


def _connect_again(model, joint, name, ends):
    """Connect a second point on the axis of a hinge, as far from the first as the machine is large."""
    size = _size(model)
    sites = [
        model.site(
            f"{name}.{end}.axis",
            model.topology.body_index(frame.body),
            pose(np.asarray(frame.offset) + size * np.asarray(axes)[:, 0]),
        )
        for (end, frame), axes in zip(ends.items(), joint.frames(), strict=True)
    ]
    model.equality("connect", f"{name}.axis", site1=sites[0], site2=sites[1])


def _instead(model: Model, cut: str) -> str:
    """What to cut in place of a joint."""
    topology = model.topology
    around = topology.loop[topology.joint_index(cut) - topology.num_bodies]
    others = [model.mechanism.joints[body] for body in np.flatnonzero(around)]
    able = [repr(joint.name) for joint in others if type(joint) in CLOSES]
    if not able:
        return "put a Revolute, Spherical or Fixed joint into its loop, and cut that by cut=True"
    return f"cut another joint of its loop by cut=True: {' or '.join(able)}"


def _drawn_apart(model, first, second):
    """The distance of two points where coordinates are zero [m]."""
    places = [
        model.drawn[model.topology.body_index(end.body)] @ [*np.asarray(end.offset), 1.0] for end in (first, second)
    ]
    return float(np.linalg.norm(places[0] - places[1]))


def _size(model: Model) -> float:
    """How far apart the joints are where coordinates are zero [m]; 1 where they are at one point."""
    mechanism, bodies = model.mechanism, range(model.topology.num_bodies)
    origins = [(model.drawn[body] @ pose_of(ends_of(mechanism, body)[1]))[:3, 3] for body in bodies]
    return float(np.ptp(origins, axis=0).max()) or 1.0
