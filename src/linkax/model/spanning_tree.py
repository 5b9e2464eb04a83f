"""Find the spanning tree of a mechanism's graph of bodies and joints, and the joints that close its loops."""

from collections import deque
from typing import NamedTuple

from linkax.model.bodies import GROUND_NAME
from linkax.model.joints.joint import AbstractJoint


class SpanningTree(NamedTuple):
    """Names of the bodies from ground outwards, the joint and the predecessor of each, and the cut joints."""

    bodies: list[str]
    carriers: list[AbstractJoint]
    predecessors: list[str]
    cuts: list[AbstractJoint]


def spanning_tree(bodies: list[str], joints: list[AbstractJoint], first: list[set[str]]) -> SpanningTree:
    """Find a spanning tree: joints named in the sets of `first`, in this order, then breadth first from ground.

    A joint whose type cannot carry a body is always cut.

    **Raises:** `ValueError` for a body that no joint connects to ground, and for a joint with
    `cut=True` that closes no loop.
    """
    ranked = _by_rank([joint for joint in joints if joint.can_carry and not joint.cut], first)
    cluster = {name: name for name in [GROUND_NAME, *bodies]}

    def find(name: str) -> str:
        while cluster[name] != name:
            name = cluster[name]
        return name

    tree = []
    for joint in ranked:
        ends = find(joint.parent.body), find(joint.child.body)
        if ends[0] != ends[1]:
            cluster[ends[0]] = ends[1]
            tree.append(joint)
    for joint in joints:
        if joint.cut and find(joint.parent.body) != find(joint.child.body):
            raise ValueError(f"joint {joint.name!r}: cut=True, but it closes no loop; remove cut=True")
    loose = [name for name in bodies if find(name) != find(GROUND_NAME)]
    if loose:
        names = ", ".join(map(repr, dict.fromkeys(name.partition("[")[0] for name in loose)))  # beams once
        raise ValueError(f"no joint connects {names} to ground; join each to lx.GROUND or to a body that is joined")
    order, carriers, predecessors = _from_ground(tree)
    in_tree = {joint.name for joint in carriers}
    return SpanningTree(order, carriers, predecessors, [joint for joint in joints if joint.name not in in_tree])


def _neighbours(joints: list[AbstractJoint]) -> dict[str, list[tuple[AbstractJoint, str]]]:
    neighbours = {}
    for joint in joints:
        neighbours.setdefault(joint.parent.body, []).append((joint, joint.child.body))
        neighbours.setdefault(joint.child.body, []).append((joint, joint.parent.body))
    return neighbours


def _by_rank(joints: list[AbstractJoint], first: list[set[str]]) -> list[AbstractJoint]:
    """Sort joints: those named in the sets of `first`, those of the breadth-first tree, the rest."""
    _, carriers, _ = _from_ground(joints)
    sets = [*first, {joint.name for joint in carriers}]
    return sorted(joints, key=lambda joint: [joint.name not in names for names in sets])


def _from_ground(joints: list[AbstractJoint]) -> tuple[list[str], list[AbstractJoint], list[str]]:
    """Walk breadth first from ground: bodies in order, the joint and the body that lead to each."""
    neighbours, queue = _neighbours(joints), deque([GROUND_NAME])
    reached, carriers, predecessors = {GROUND_NAME: None}, [], []
    while queue:
        body = queue.popleft()
        for joint, other in neighbours.get(body, []):
            if other not in reached:
                reached[other] = None
                carriers.append(joint)
                predecessors.append(body)
                queue.append(other)
    return list(reached)[1:], carriers, predecessors
