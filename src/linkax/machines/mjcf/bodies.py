"""Bodies of MJCF: massless ones between their joints, mass and inertia, sites, and geoms."""

import numpy as np

from linkax.machines.mjcf.compiled import Compiled
from linkax.machines.mjcf.joints import read_joint
from linkax.machines.mjcf.shapes import read_shape
from linkax.machines.parts import Place
from linkax.machines.poses import from_quaternion, pose, turned
from linkax.model.joints.fixed import Fixed
from linkax.model.names import free_name

HIDDEN_GROUP = 3  # geoms of this group and later ones, MuJoCo's viewer hides, such as those of contact alone


def read_body(compiled: Compiled, index: int) -> None:
    """Read a body with its joints, and massless ones between them where it has several."""
    model = compiled.model
    draft = compiled.draft
    where = compiled.where("body", index)
    name = compiled.body_names[index]
    parent = compiled.body_names[model.body_parentid[index]]
    own = pose(model.body_pos[index], from_quaternion(model.body_quat[index]))
    drawn = draft.poses[parent] @ own
    first = int(model.body_jntadr[index])
    count = int(model.body_jntnum[index])
    chain = [free_name(f"{name}[{step}]", compiled.body_names) for step in range(1, count)]
    for between in chain:
        draft.body(between, drawn, 0.0, np.zeros(3), np.zeros((3, 3)), where)
    principal = from_quaternion(model.body_iquat[index])
    inertia = turned(np.diag(model.body_inertia[index]), principal)
    at = np.array(model.body_ipos[index])
    sites = compiled.elements("site")
    of_body = [site for site in range(model.nsite) if model.site_bodyid[site] == index and sites[site].name]
    frames = {sites[site].name: np.array(model.site_pos[site]) for site in of_body}
    mass = float(model.body_mass[index])
    draft.body(name, drawn, mass, at, inertia, where, frames)
    carried = -mass * float(model.body_gravcomp[index]) * compiled.gravity
    if np.any(carried):
        draft.carry(name, at, carried, where)
        _check_carrying(compiled, index)
    if model.body_mocapid[index] >= 0:
        draft.leave_out(where, "mocap", "the body is moved by motion capture; it stays as drawn")
    begin = int(model.body_geomadr[index])
    for geom in range(begin, begin + int(model.body_geomnum[index])):
        if compiled.has("CONTACT") and model.geom_contype[geom] | model.geom_conaffinity[geom]:
            draft.leave_out(compiled.where("geom", geom), "contact", f"contact of body {name!r} with others")
        if model.geom_group[geom] < HIDDEN_GROUP:
            read_shape(compiled, geom, name)
    stations = [Place.at(parent, own), *(Place.at(between, np.eye(4)) for between in (*chain, name))]
    if not count:
        fixed = free_name(f"{name}.fixed", compiled.joint_names)
        draft.joint_at(Fixed, fixed, stations[0], stations[-1], where)
    for step in range(count):
        read_joint(compiled, first + step, stations[step], stations[step + 1])


def _check_carrying(compiled: Compiled, index: int) -> None:
    """Tell where actuators of joints are to carry a body, and cannot as the force that carries it here."""
    model = compiled.model
    name = compiled.body_names[index]
    actuated = model.nu and compiled.has("ACTUATION")
    while index:
        first = int(model.body_jntadr[index])
        for joint in range(first, first + int(model.body_jntnum[index])):
            if model.jnt_actgravcomp[joint] and (model.jnt_actfrclimited[joint] or not actuated):
                reason = "the range of its force limits" if actuated else "MuJoCo leaves out, without an actuator,"
                where = compiled.where("joint", joint)
                compiled.draft.leave_out(where, "actuator", f"{reason} what carries body {name!r} along it")
        index = int(model.body_parentid[index])
