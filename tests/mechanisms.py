"""Mechanisms of the tests, whose names and numbers are traced alike wherever they are used, and so share programs.

A pendulum, a crank-slider, a sleigh, a rolling disc, a four-bar, a coupler between balls, a Sarrus linkage; Bricard's,
the spatial four-link, rows of four-bars and cranes are scenes (`known_answers.start`). `POOL` has random ones, with all
joints, beams, forces and constraints, for laws that hold for all of them.
"""

import copy
import itertools

import jax
import jax.numpy as jnp
import numpy as np

import linkax as lx


def down(gravity):
    """Gravity along −y [m/s²]."""
    return lx.Gravity([0.0, -gravity, 0.0])


def pendulum(length=1.0, mass=1.0, gravity=9.81, forces=(), constraints=()):
    """A rod `arm` on a `hinge` about z, which points along x at zero."""
    arm = lx.rod("arm", length, mass)
    hinge = lx.Revolute("hinge", lx.GROUND, arm.at("base"), axis="z")
    return lx.Mechanism([arm], [hinge], [down(gravity), *forces], constraints)


def crank_slider(
    cut=None, order=1, offset=(0.0, 0.0, 0.0), crank=1.0, rod=1.3, masses=(1.0, 2.0, 0.5), forces=(), constraints=()
):
    """The planar crank-slider; `order` -1 declares its joints the other way round."""
    offset = np.array(offset)
    bar, link = lx.rod("crank", crank, masses[0]), lx.rod("rod", rod, masses[1])
    slider = lx.point_mass("slider", masses[2])
    options = lambda name: {"cut": True} if name == cut else {}
    joints = [
        lx.Revolute("bearing", lx.GROUND.at(offset), bar.at("base"), axis="z", **options("bearing")),
        lx.Revolute("crank_pin", bar.at("tip"), link.at("base"), axis="z", **options("crank_pin")),
        lx.Revolute("wrist_pin", link.at("tip"), slider, axis="z", **options("wrist_pin")),
        lx.Prismatic("guide", lx.GROUND.at(offset), slider, axis="x", **options("guide")),
    ]
    return lx.Mechanism([bar, link, slider], joints[::order], [down(9.81), *forces], constraints)


def sleigh(apart):
    """A plate on an edge, its centre of mass `apart` ahead of it; it turns at 2 rad/s and goes at 0.5 m/s."""
    plate = lx.RigidBody("plate", 2.0, jnp.array([1.0, 0.0, 0.0]) * apart, 0.3)
    ice = lx.Planar("ice", lx.GROUND, plate, "z")
    mechanism = lx.Mechanism([plate], [ice], constraints=[lx.Skate("edge", plate, lx.GROUND)])
    return mechanism, lx.State(jnp.zeros(3), jnp.array([2.0, 0.5, 0.0]))


def rolling_disc(tilt, turning, spin, radius=0.4, mass=1.5):
    """A thin disc that rolls with precession `turning` about the vertical, and a rate `spin` about its axis z.

    It heads along y, and leans to x by `tilt`.
    """
    axial, across = mass * radius**2 / 2.0, mass * radius**2 / 4.0
    disc = lx.RigidBody("disc", mass, inertia=[across, across, axial])
    rolling = lx.RollingDisc("rolling", disc, lx.GROUND, radius)
    joint = lx.Free("flight", lx.GROUND, disc)
    mechanism = lx.Mechanism([disc], [joint], [lx.Gravity([0.0, 0.0, -9.81])], [rolling])
    sine, cosine, half = jnp.sin(tilt), jnp.cos(tilt), tilt / 2.0 - jnp.pi / 4.0
    omega = turning * jnp.array([0.0, 0.0, 1.0]) + spin * jnp.stack([-cosine, 0.0 * sine, sine])
    centre = radius * jnp.stack([sine, 0.0 * sine, cosine])
    turn = jnp.stack([jnp.cos(half), 0.0 * half, jnp.sin(half), 0.0 * half])
    return mechanism, lx.State(jnp.append(turn, centre), jnp.append(omega, jnp.cross(omega, centre)))


def steady_spin(tilt, turning, radius=0.4):
    """The rate about the axis at which a uniform thin disc keeps its tilt α, at a precession Ω (Routh, art. 244).

    Moments about the contact: (C + m r²) n Ω cos α = A Ω² sin α cos α − m g r sin α, n the rate about the axis in all.
    """
    sine, cosine = np.sin(tilt), np.cos(tilt)
    needed = radius**2 / 4.0 * turning**2 * sine * cosine - 9.81 * radius * sine
    return needed / (1.5 * radius**2 * turning * cosine) - turning * sine


def four_bar(
    crank=0.4, coupler=1.0, rocker=0.9, ground=1.0, masses=(1.0, 1.0, 1.0), cut=None, forces=(), constraints=()
):
    """The planar four-bar, its rods along x at zero."""
    lengths = {"crank": crank, "coupler": coupler, "rocker": rocker}
    rods = [lx.rod(name, length, mass) for (name, length), mass in zip(lengths.items(), masses, strict=True)]
    first, middle, last = rods
    options = lambda name: {"cut": True} if name == cut else {}
    joints = [
        lx.Revolute("crank_bearing", lx.GROUND, first.at("base"), axis="z", **options("crank_bearing")),
        lx.Revolute("crank_pin", first.at("tip"), middle.at("base"), axis="z", **options("crank_pin")),
        lx.Revolute("rocker_pin", middle.at("tip"), last.at("tip"), axis="z", **options("rocker_pin")),
        lx.Revolute(
            "rocker_bearing", lx.GROUND.at([ground, 0.0, 0.0]), last.at("base"), "z", **options("rocker_bearing")
        ),
    ]
    return lx.Mechanism(rods, joints, [down(9.81), *forces], constraints)


def coupler_between_balls():
    """An arm that moves a slide by a coupler, whose spin nothing holds."""
    arm, slider = lx.rod("arm", 0.5, 1.0), lx.point_mass("slider", 1.0)
    coupler = lx.rod("coupler", 1.0, 1.0, thickness=0.1)
    joints = [
        lx.Revolute("hinge", lx.GROUND, arm.at("base"), axis="z"),
        lx.Spherical("near", arm.at("tip"), coupler.at("base")),
        lx.Spherical("far", coupler.at("tip"), slider),
        lx.Prismatic("guide", lx.GROUND.at([0.0, 0.0, 0.2]), slider, axis="x"),
    ]
    return lx.Mechanism([arm, coupler, slider], joints)


def sarrus():
    """Two legs of two links in perpendicular planes, which carry a platform that only rises and falls."""
    length, mass, width, out = 0.5, 0.5, 0.02, np.array([0.4, 0.0, 0.0])
    moments = np.array([width**2 / 6, (length**2 + width**2) / 12, (length**2 + width**2) / 12])
    link = lambda name: lx.RigidBody(
        name, mass, [length / 2, 0.0, 0.0], jnp.asarray(mass * moments), {"tip": [length, 0.0, 0.0]}
    )
    platform = lx.RigidBody("platform", 2.0)
    bodies, joints = [platform], []
    for leg, turn in (("x", np.eye(3)), ("y", np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))):
        lower, upper = link(f"lower_{leg}"), link(f"upper_{leg}")
        bodies += [lower, upper]
        joints += [
            lx.Revolute(f"base_{leg}", lx.GROUND.at(turn @ out, turn), lower, axis="-y"),
            lx.Revolute(f"knee_{leg}", lower.at("tip"), upper, axis="-y"),
            lx.Revolute(f"top_{leg}", upper.at("tip"), platform.at(turn @ out, turn), axis="-y"),
        ]
    return lx.Mechanism(bodies, joints, [lx.Gravity([0.0, 0.0, -9.81])])


def raised(angle, speeds):
    """A Sarrus linkage whose legs stand at an angle from the ground [rad], both alike, with speeds of joints."""
    mechanism = sarrus()
    of_joint = {"base": angle, "knee": np.pi - 2.0 * angle, "top": angle - np.pi}
    positions = {f"{name}_{leg}": value for name, value in of_joint.items() for leg in "xy"}
    held = {name: positions[name] for name in ("base_x", "base_y", "knee_x", "knee_y")}
    guess = {name: value for name, value in positions.items() if name in mechanism.topology.coordinates}
    return mechanism, lx.assemble(mechanism, held, speeds, guess=guess)


def raised_exactly(mechanism, angle, speed):
    """The same as a state, without assembly: legs alike, with one speed [rad/s]."""
    of_joint = {"base": (angle, speed), "knee": (np.pi - 2.0 * angle, -2.0 * speed), "top": (angle - np.pi, speed)}
    of_coordinates = [of_joint[name.split("_")[0]] for name in mechanism.topology.coordinates]
    return lx.State(*(np.array(part) for part in zip(*of_coordinates, strict=True)))


# Axes in the plane z = 0 as drawn, a place on each, and k of tan(angle / 2) = k tan(turn / 2), exactly.
HINGES = {
    "h1": ((1, 0), (0, 0), 1.0),
    "h2": ((0, 1), (1 / 3, 0), 3.0),
    "h3": ((1, 1), (-1, 1), 2**0.5),
    "k1": ((47, 23), (276 / 1369, -564 / 1369), 2**0.5),
    "k2": ((-93, 1440), (-164 * 1440 / 1443**2, -164 * 93 / 1443**2), 3.0),
    "k3": ((12, 5), (-85 / 169, 204 / 169), 1.0),
}


def folding():
    """A redundant loop of six hinges, which lie in a plane twice a turn: the rank falls from 4 to 2."""
    names = "A1", "A2", "tool", "B2", "B1"
    bodies = {
        name: lx.RigidBody(name, 1.0 + 0.2 * i, [0.1 * i - 0.2, 0.2, 0.05 * i], [0.1, 0.12, 0.15])
        for i, name in enumerate(names)
    }
    chains = (
        [lx.GROUND, bodies["A1"], bodies["A2"], bodies["tool"]],
        [lx.GROUND, bodies["B1"], bodies["B2"], bodies["tool"]],
    )
    pairs = [pair for chain in chains for pair in itertools.pairwise(chain)]
    joints = [
        lx.Revolute(name, parent.at([*place, 0.0]), child.at([*place, 0.0]), axis=[*axis, 0.0])
        for (name, (axis, place, _)), (parent, child) in zip(HINGES.items(), pairs, strict=True)
    ]
    return lx.Mechanism(list(bodies.values()), joints, [lx.Gravity([0.0, 0.0, -9.81])])


def folded(mechanism, turn):
    """Coordinates of `folding` at turns of its first hinge, (..., n_q), and their derivatives by it."""
    rates = np.array([HINGES[name][2] for name in mechanism.topology.coordinates])
    whole = np.round(np.asarray(turn)[..., None] / (2.0 * np.pi))
    half = np.asarray(turn)[..., None] / 2.0 - np.pi * whole
    cosine, sine = np.cos(half), rates * np.sin(half)
    return 2.0 * np.arctan2(sine, cosine) + 2.0 * np.pi * whole, rates / (cosine**2 + sine**2)


def with_cut(mechanism, name):
    """The same mechanism with another joint cut."""

    def again(joint):
        joint = copy.copy(joint)
        object.__setattr__(joint, "cut", joint.name == name)
        return joint

    joints = [again(joint) for joint in mechanism.joints]
    return lx.Mechanism(mechanism.bodies, joints, mechanism.forces, mechanism.constraints)


class Numbers:
    """Random numbers for a mechanism, all of them traced: axes and rotations too."""

    def __init__(self, seed):
        self.generator = np.random.default_rng(seed)

    def vector(self, size=3):
        return jnp.array(self.generator.normal(size=size))

    def positive(self):
        return 0.5 + self.generator.random()

    def body(self, name):
        root = self.generator.normal(size=(3, 3))
        inertia = np.trace(root @ root.T) * np.eye(3) - root @ root.T
        return lx.RigidBody(name, self.positive(), self.vector(), inertia)

    def frame(self, place):
        q, _ = np.linalg.qr(self.generator.normal(size=(3, 3)))
        return place.at(self.vector(), jnp.array(q * np.sign(np.linalg.det(q))))

    def joint(self, kind, name, parent, child, **options):
        """A joint of any type between frames of any rotation."""
        if kind in (lx.Revolute, lx.Prismatic, lx.Cylindrical, lx.Planar, lx.Universal, lx.Screw):
            options["axis"] = self.vector()
        if kind is lx.Screw:
            options["pitch"] = self.positive()
        if kind is lx.Distance:
            options["length"] = self.positive()
        return kind(name, self.frame(parent), self.frame(child), **options)


GRAVITY = lx.Gravity([0.3, -9.81, 1.0])
KINDS = (
    lx.Revolute,
    lx.Universal,
    lx.Spherical,
    lx.Prismatic,
    lx.Cylindrical,
    lx.Fixed,
    lx.Planar,
    lx.Free,
    lx.Screw,
    lx.Distance,
)


def both_roles(kind, seed):
    """A joint type in the tree, against its direction and along it, and cut, to ground and between bodies."""
    numbers = Numbers(seed)
    a, b, c = (numbers.body(f"body_{i}") for i in range(3))
    carrying = kind if kind is not lx.Distance else lx.Spherical
    cut = {} if kind is lx.Distance else {"cut": True}
    joints = [
        numbers.joint(carrying, "backward", a, lx.GROUND),
        numbers.joint(carrying, "forward", a, b),
        numbers.joint(lx.Revolute, "branch", lx.GROUND, c),
        numbers.joint(kind, "closing", b, c, **cut),
        numbers.joint(kind, "to_ground", lx.GROUND, b, **cut),
    ]
    forces = [
        GRAVITY,
        lx.Spring(a.at([0.1, 0.2, 0.3]), c, 3.0, 0.4),
        lx.Damper(lx.GROUND.at([0.1, 0.2, 0.3]), b, 0.5),
        lx.JointDamper("branch", 0.7),
        lx.PointForce(b.at([0.3, 0.1, 0.0]), [1.0, 2.0, 3.0], axes="frame"),
    ]
    if joints[3].speed_units:
        forces.append(lx.JointTorque(("closing", len(joints[3].speed_units) - 1), 1.5))
    return lx.Mechanism([a, b, c], joints, forces)


def floating(seed):
    """A loop of four unlike joints that touches nothing, under forces of its own."""
    numbers = Numbers(seed)
    bodies = [numbers.body(f"body_{i}") for i in range(4)]
    kinds = (lx.Universal, lx.Spherical, lx.Cylindrical, lx.Revolute)
    around = zip(kinds, bodies, [*bodies[1:], bodies[0]], strict=True)
    joints = [numbers.joint(kind, f"joint_{i}", *ends) for i, (kind, *ends) in enumerate(around)]
    joints.append(lx.Free("afloat", lx.GROUND, bodies[0]))
    forces = [lx.JointSpring("joint_3", 2.0), lx.Spring(bodies[0], bodies[2], 3.0), lx.JointDamper(("joint_1", 0), 1.0)]
    forces += [lx.JointInertia("joint_3", 0.7), lx.JointInertia(("joint_1", 2), 0.4)]
    return lx.Mechanism(bodies, joints, forces)


def cut(seed):
    """Joints of all types cut, to ground and between two bodies in turn."""
    numbers = Numbers(seed)
    a, b = numbers.body("a"), numbers.body("b")
    joints = [numbers.joint(lx.Revolute, "hinge", lx.GROUND, a), numbers.joint(lx.Spherical, "ball", b, a)]
    for i, kind in enumerate(KINDS):
        options = {"cut": True} if kind.can_carry else {}
        joints.append(numbers.joint(kind, f"cut_{i}", (lx.GROUND, a)[i % 2], b, **options))
    return lx.Mechanism([a, b], joints, [GRAVITY])


def driven(seed):
    """A drive and a coupling in loops that share joints, under all forces along joints."""
    numbers = Numbers(seed)
    a, b, c, d = (numbers.body(f"body_{i}") for i in range(4))
    joints = [
        numbers.joint(lx.Revolute, "motor", lx.GROUND, a),
        numbers.joint(lx.Cylindrical, "sleeve", a, b),
        numbers.joint(lx.Prismatic, "slide", c, b),
        numbers.joint(lx.Planar, "table", lx.GROUND, d),
        numbers.joint(lx.Spherical, "ball", c, d, cut=True),
        numbers.joint(lx.Universal, "cardan", c, lx.GROUND, cut=True),
    ]
    constraints = [
        lx.Drive("drive", "motor", jax.tree_util.Partial(_wave, numbers.positive())),
        lx.Coupling("rope", {"slide": 2.0, ("sleeve", 1): -1.0, ("table", 2): 0.5}, offset=numbers.positive()),
    ]
    forces = [
        GRAVITY,
        lx.JointSpring(("sleeve", 0), 2.0, 0.1),
        lx.JointTorque(("cardan", 1), 1.3),
        lx.JointFriction("slide", 1.0, 0.2),
        lx.JointInertia("motor", 0.6),
        lx.JointInertia("slide", 0.9),
        lx.JointTorque(("table", 0), jax.tree_util.Partial(_restoring, 0.4)),
    ]
    return lx.Mechanism([a, b, c, d], joints, forces, constraints)


def _restoring(factor, t, motion):
    return -factor * motion.joint("table")[0] * jnp.cos(t) + motion.joint_speed("slide")


def _wave(numbers, t):
    return numbers * jnp.sin(t)


def bending(seed):
    """Two beams in a loop, one held by its tip: attachments along and off their axes, and a sleeve that slides."""
    numbers = Numbers(seed)
    pair = lambda: jnp.array([numbers.positive(), numbers.positive()])
    section = lambda: lx.Section(pair(), numbers.positive(), numbers.positive(), numbers.positive(), pair())
    every = lx.Beam("every", numbers.positive(), section(), elements=2, shear=True)
    slender = lx.Beam("slender", numbers.positive(), section(), elements=1, bends="z", torsion=False)
    body, sleeve = numbers.body("body"), lx.point_mass("sleeve", numbers.positive())
    along = lambda beam, *off: beam.at(jnp.array([0.6 * beam.length, *off]))
    joints = [
        numbers.joint(lx.Revolute, "hinge", body, lx.GROUND),
        lx.Fixed("weld", body, every.at("tip")),
        lx.Universal("cardan", every.at("base"), along(slender, 0.1, 0.2), axis="y"),
        lx.Sliding("slide", every, sleeve),
        lx.Spherical("ball", sleeve, slender.at("tip"), cut=True),
    ]
    forces = [
        GRAVITY,
        lx.Spring(along(every, 0.0, 0.0), lx.GROUND, 2.0, 0.3),
        lx.JointSpring("slide", 1.5, 0.2),
        lx.JointInertia("slide", 0.8),
        lx.PointForce(every.at("base"), [1.0, 2.0, 3.0], axes="frame"),
    ]
    around = [lx.GROUND.at(numbers.vector()), every.at("tip"), along(slender, 0.1, 0.0), sleeve]
    forces.append(lx.ElasticRope(around, 2.0, 0.1))
    ropes = [
        lx.Rope("rope", around[::-1], numbers.positive()),
        lx.Rope("winch", around[1:3], jax.tree_util.Partial(_wave, numbers.positive())),
    ]
    return lx.Mechanism([every, slender, body, sleeve], joints, forces, ropes)


POOL = {
    "planar": lambda seed: crank_slider(rod=1.0 + Numbers(seed).positive()),
    **{kind.__name__: lambda seed, kind=kind: both_roles(kind, seed) for kind in KINDS},
    "floating": floating,
    "cut": cut,
    "driven": driven,
    "bending": bending,
}
