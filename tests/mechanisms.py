"""A pool of mechanisms for laws that hold for all of them."""

import numpy as np

import linkax as lx


def crank_slider(cut=None, order=1, offset=(0.0, 0.0, 0.0), rod=1.3):
    """The planar crank-slider; `order` -1 declares its joints the other way round."""
    offset = np.array(offset)
    crank, link = lx.rod("crank", length=1.0, mass=1.0), lx.rod("rod", length=rod, mass=2.0)
    slider = lx.point_mass("slider", mass=0.5)
    options = lambda name: {"cut": True} if name == cut else {}
    joints = [
        lx.Revolute("bearing", lx.GROUND.at(offset), crank.at("base"), axis="z", **options("bearing")),
        lx.Revolute("crank_pin", crank.at("tip"), link.at("base"), axis="z", **options("crank_pin")),
        lx.Revolute("wrist_pin", link.at("tip"), slider, axis="z", **options("wrist_pin")),
        lx.Prismatic("guide", lx.GROUND.at(offset), slider, axis="x", **options("guide")),
    ]
    return lx.Mechanism([crank, link, slider], joints[::order], [lx.Gravity([0.0, -9.81, 0.0])])


def rotation(generator):
    q, _ = np.linalg.qr(generator.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def spatial(seed):
    """Bodies of any shape in loops of revolute, prismatic and fixed joints, in frames of any
    rotation, some joints declared against the tree's direction and some from ground's side."""
    generator = np.random.default_rng(seed)

    def body(name):
        root = generator.normal(size=(3, 3))
        inertia = np.trace(root @ root.T) * np.eye(3) - root @ root.T
        return lx.RigidBody(name, 1.0 + generator.random(), generator.normal(size=3), inertia)

    bodies = [body(f"body_{i}") for i in range(5)]
    frame = lambda place: place.at(generator.normal(size=3), rotation(generator))
    axis = lambda: generator.normal(size=3)
    joints = [
        lx.Revolute("to_ground", frame(bodies[0]), frame(lx.GROUND), axis()),
        lx.Prismatic("slide", frame(bodies[1]), frame(bodies[0]), axis()),
        lx.Revolute("forward", frame(bodies[1]), frame(bodies[2]), axis()),
        lx.Fixed("weld", frame(bodies[4]), frame(bodies[2])),
        lx.Revolute("backward", frame(bodies[3]), frame(bodies[2]), axis()),
        lx.Prismatic("closing_slide", frame(bodies[3]), frame(bodies[0]), axis(), cut=True),
        lx.Revolute("closing_hinge", frame(bodies[4]), frame(lx.GROUND), axis(), cut=True),
    ]
    return lx.Mechanism(bodies, joints, [lx.Gravity([0.3, -9.81, 1.0])])


POOL = {
    "crank-slider": crank_slider(),
    "crank-slider, guide cut": crank_slider(cut="guide"),
    "crank-slider, bearing cut": crank_slider(cut="bearing", order=-1),
    "spatial, seed 0": spatial(0),
    "spatial, seed 1": spatial(1),
}
