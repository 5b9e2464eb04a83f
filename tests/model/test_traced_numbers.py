"""Numbers that JAX traces are checked as those that are known: one that cannot be is NaN, in its member alone."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx
from linkax.model.bodies import AbstractBody
from linkax.model.constraints.constraint import AbstractConstraint

LINK = lx.rod("link", 1.0, 1.0)
STEEL = lx.Material(2.1e11, 0.3, 7850.0)
ENDS = {"parent": lx.GROUND, "child": LINK}
POINTS = [lx.GROUND, LINK.at("tip")]
STIFF = lx.Section(1.0, 1.0, 1.0, 1.0, 1.0)


def slender(**options):
    return lx.Beam("boom", **{"length": 1.0, "section": STIFF, "elements": 2, "torsion": False} | options)


NONE = [np.nan, np.inf]
POSITIVE = [*NONE, 0.0, -1.0]
NOT_NEGATIVE = [*NONE, -1.0]
VECTOR = (np.ones(3), [[1.0, np.nan, 0.0], [np.inf, 0.0, 0.0]])
AXIS = (np.array([1.0, 0.0, 0.0]), [*VECTOR[1], np.zeros(3), [1e200, 1e200, 0.0]])
ROTATION = (np.eye(3), [2.0 * np.eye(3), np.diag([1.0, 1.0, -1.0]), np.zeros((3, 3)), np.full((3, 3), np.nan)])
RANGE = (np.array([-1.0, 1.0]), [[1.0, -1.0], [0.0, 0.0], [np.nan, 1.0], [0.0, np.inf]])
INERTIA = (
    np.eye(3),
    [np.diag([1.0, 1.0, -0.5]), np.diag([1.0, 1.0, 2.5]), np.eye(3) + np.eye(3, k=1), np.full((3, 3), np.inf)],
)
HYDRAULIC = {"areas": (1.0, 1.0), "stroke": 1.0, "valve": 1.0, "supply": 1e7, "dead_volume": 1.0}
LAW = lx.ContactLaw(1.0)
ALONG_AN_AXIS = lx.Revolute, lx.Prismatic, lx.Cylindrical, lx.Planar, lx.Rectangular, lx.Universal, lx.ConstantVelocity
# For each element a number of it that is traced, a value that it can have, and those that it cannot have.
CASES = {
    "body: mass": (lambda x: lx.RigidBody("body", x), 1.0, NOT_NEGATIVE),
    "body: centre of mass": (lambda x: lx.RigidBody("body", 1.0, x), *VECTOR),
    "body: inertia": (lambda x: lx.RigidBody("body", 1.0, inertia=x), *INERTIA),
    "body: principal moments": (
        lambda x: lx.RigidBody("body", 1.0, inertia=x), np.ones(3),
        [[1.0, 1.0, -0.5], [1.0, 2.5, 1.0], [1.0, np.nan, 1.0]],
    ),
    "body: frame": (lambda x: lx.RigidBody("body", 1.0, frames={"tip": x}), *VECTOR),
    "body: offset": (LINK.at, *VECTOR),
    "body: rotation": (lambda x: LINK.at("tip", x), *ROTATION),
    "ground: offset": (lx.GROUND.at, *VECTOR),
    "ground: rotation": (lambda x: lx.GROUND.at([0.0, 0.0, 0.0], x), *ROTATION),
    "rod: length": (lambda x: lx.rod("rod", x, 1.0), 1.0, POSITIVE),
    "rod: thickness": (lambda x: lx.rod("rod", 1.0, 1.0, x), 0.1, NOT_NEGATIVE),
    "rod: tip": (lambda x: lx.rod_between("rod", [0.0, 0.0, 0.0], x, 1.0), *VECTOR),
    "body: place": (lambda x: LINK.placed(x), *VECTOR),
    "body: orientation": (lambda x: LINK.placed([0.0, 0.0, 0.0], x), *ROTATION),
    "rod: mass": (lambda x: lx.rod("rod", 1.0, x), 1.0, NOT_NEGATIVE),
    "box: size": (lambda x: lx.box("box", x, 1.0), np.ones(3), [[1.0, 0.0, 1.0], [1.0, 1.0, -1.0], [1.0, np.inf, 1.0]]),
    "box: mass": (lambda x: lx.box("box", [1.0, 2.0, 3.0], x), 1.0, NOT_NEGATIVE),
    "point mass": (lambda x: lx.point_mass("point", x), 1.0, NOT_NEGATIVE),
    **{
        f"{kind.__name__}: axis": (lambda x, kind=kind: kind("joint", **ENDS, axis=x), *AXIS)
        for kind in ALONG_AN_AXIS
    },
    **{
        f"{kind.__name__}: offset": (lambda x, kind=kind: kind("joint", lx.GROUND.at(x), LINK), *VECTOR)
        for kind in (lx.Spherical, lx.Fixed, lx.Free)
    },
    "second axis": (
        lambda x: lx.Universal("joint", **ENDS, axis="z", second_axis=x), AXIS[0], [*AXIS[1], [1.0, 0.0, 1.0]],
    ),
    "axis next to a second one": (
        lambda x: lx.Universal("joint", **ENDS, axis=x, second_axis="y"), AXIS[0], [[1.0, 1.0, 0.0]],
    ),
    "Screw: pitch": (lambda x: lx.Screw("nut", **ENDS, axis="x", pitch=x), -1.0, [*NONE, 0.0]),
    "Distance: length": (lambda x: lx.Distance("tie", **ENDS, length=x), 1.0, POSITIVE),
    "Rope: length": (lambda x: lx.Rope("hoist", POINTS, x), 1.0, POSITIVE),
    "ElasticRope: stiffness": (lambda x: lx.ElasticRope(POINTS, x, 1.0), 1.0, POSITIVE),
    "ElasticRope: free length": (lambda x: lx.ElasticRope(POINTS, 1.0, x), 1.0, POSITIVE),
    "ElasticRope: damping": (lambda x: lx.ElasticRope(POINTS, 1.0, 1.0, x), 0.0, NOT_NEGATIVE),
    "Coupling: coefficients": (lambda x: lx.Coupling("gears", {"pin": x, "knee": 0.0}), 1.0, [*NONE, 0.0]),
    "Coupling: offset": (lambda x: lx.Coupling("gears", {"pin": 1.0}, x), -1.0, NONE),
    "PolynomialCoupling: coefficients": (lambda x: lx.PolynomialCoupling("curve", "pin", "knee", x), *VECTOR),
    "PolynomialCoupling: factor": (
        lambda x: lx.PolynomialCoupling("curve", {"pin": x}, "knee", [0.0, 1.0, 2.0]), -1.0, [*NONE, 0.0],
    ),
    "Gravity": (lx.Gravity, *VECTOR),
    "Spring: stiffness": (lambda x: lx.Spring(*POINTS, x), -1.0, NONE),
    "Spring: free length": (lambda x: lx.Spring(*POINTS, 1.0, x), 0.0, NOT_NEGATIVE),
    "Damper": (lambda x: lx.Damper(*POINTS, x), -1.0, NONE),
    "PointForce": (lambda x: lx.PointForce(LINK, x), *VECTOR),
    "PointMoment": (lambda x: lx.PointMoment(LINK, x), *VECTOR),
    "JointTorque": (lambda x: lx.JointTorque("pin", x), -1.0, NONE),
    "JointSpring: stiffness": (lambda x: lx.JointSpring("pin", x), -1.0, NONE),
    "JointSpring: free": (lambda x: lx.JointSpring("pin", 1.0, x), -1.0, NONE),
    "JointDamper": (lambda x: lx.JointDamper("pin", x), -1.0, NONE),
    "JointFriction: torque": (lambda x: lx.JointFriction("pin", x, 1.0), 0.0, NOT_NEGATIVE),
    "JointFriction: scale": (lambda x: lx.JointFriction("pin", 1.0, x), 1.0, POSITIVE),
    "JointInertia": (lambda x: lx.JointInertia("pin", x), 0.0, NOT_NEGATIVE),
    "Rack: module": (lambda x: lx.Rack("rack", *POINTS, 20, x), 1.0, POSITIVE),
    "Gear: offset": (lambda x: lx.Gear("gear", lx.GROUND.at(x), LINK, (20, 30)), *VECTOR),
    "RollingDisc: radius": (lambda x: lx.RollingDisc("disc", LINK, lx.GROUND, x), 1.0, POSITIVE),
    "RollingSphere: radius": (lambda x: lx.RollingSphere("ball", LINK, lx.GROUND, x), 1.0, POSITIVE),
    "Skate: offset": (lambda x: lx.Skate("edge", LINK, lx.GROUND.at(x)), *VECTOR),
    "PointOnSurface: offset": (lambda x: lx.PointOnSurface("bowl", LINK, lx.GROUND.at(x), jnp.sum), *VECTOR),
    "Prescribed: offset": (lambda x: lx.Prescribed("lift", LINK.at(x), lambda t: t * jnp.ones(3)), *VECTOR),
    "Cam: roller": (lambda x: lx.Cam("cam", lx.GROUND, LINK, jnp.cos, x), 0.0, NOT_NEGATIVE),
    "CurveJoint: up": (lambda x: lx.CurveJoint("wire", lx.GROUND, LINK, lambda u: u * jnp.ones(3), up=x), *VECTOR),
    "AffineActuator: factor": (lambda x: lx.AffineActuator({"pin": x}), -1.0, [*NONE, 0.0]),
    "AffineActuator: bias": (lambda x: lx.AffineActuator("pin", bias=x), *VECTOR),
    "AffineActuator: gain": (lambda x: lx.AffineActuator("pin", gain=x), *VECTOR),
    "AffineActuator: force range": (lambda x: lx.AffineActuator("pin", force_range=x), *RANGE),
    "DCMotor: inductance": (
        lambda x: lx.DCMotor("pin", 1.0, resistance=1.0, inductance=x, constant=1.0), 1.0, POSITIVE,
    ),
    "HydraulicCylinder: bulk modulus": (
        lambda x: lx.HydraulicCylinder(*POINTS, 0.0, **HYDRAULIC, closed=1.0, bulk_modulus=x), 1.0, POSITIVE,
    ),
    "HydraulicActuator: leakage": (
        lambda x: lx.HydraulicActuator("pin", 0.0, **HYDRAULIC, closed=-1.0, leakage=x), 0.0, NOT_NEGATIVE,
    ),
    "PneumaticSpring: area": (
        lambda x: lx.PneumaticSpring(*POINTS, area=x, free_length=1.0, pressure=1e6), 1.0, POSITIVE,
    ),
    "PIDController: integral": (lambda x: lx.PIDController("pin", 0.0, proportional=1.0, integral=x), -1.0, NONE),
    "FirstOrderSensor: time constant": (lambda x: lx.FirstOrderSensor(lambda t, motion: t, x), 1.0, POSITIVE),
    "LuGreFriction: stiffness": (
        lambda x: lx.LuGreFriction("pin", coulomb=1.0, static=1.5, stribeck_speed=0.1, stiffness=x), 1.0, POSITIVE,
    ),
    "MaxwellElement: damping": (lambda x: lx.MaxwellElement(*POINTS, 1.0, x), 1.0, POSITIVE),
    "ContactLaw: stiffness": (lx.ContactLaw, 1.0, POSITIVE),
    "JointLimit: lower": (lambda x: lx.JointLimit("pin", LAW, lower=x), -1.0, NONE),
    "Impact: restitution": (lambda x: lx.Impact("pin", lower=0.0, restitution=x), 0.5, [*NONE, -0.1, 1.1]),
    "Contact: radius": (lambda x: lx.Contact(lx.Sphere(LINK, x), lx.Plane(lx.GROUND), LAW), 1.0, NOT_NEGATIVE),
    "WheelRailContact: span": (
        lambda x: lx.WheelRailContact(LINK, lx.GROUND, radius=jnp.cos, height=jnp.sin, span=x, law=LAW), *RANGE,
    ),
    "WheelOnRail: offset": (
        lambda x: lx.WheelOnRail("w", LINK, lx.GROUND.at(x), radius=jnp.cos, height=jnp.sin, span=[0.0, 1.0]), *VECTOR,
    ),
    "Creep: friction": (lambda x: lx.Creep(1.0, 1.0, x), 0.3, POSITIVE),
    "Clearance": (lambda x: lx.Clearance(*POINTS, clearance=x, radius=1.0, law=LAW), 0.1, POSITIVE),
    "Material: modulus": (lambda x: lx.Material(x, 0.3, 1.0), 1.0, POSITIVE),
    "Material: Poisson's ratio": (lambda x: lx.Material(1.0, x, 1.0), 0.5, [*NONE, -1.0, 0.6]),
    "Material: density": (lambda x: lx.Material(1.0, 0.3, x), 1.0, POSITIVE),
    "Section: bending": (lambda x: lx.Section(x, 1.0), np.ones(2), [[1.0, 0.0], [-1.0, 1.0], [1.0, np.nan]]),
    "Section: density": (lambda x: lx.Section(1.0, x), 1.0, POSITIVE),
    "Section: stretch": (lambda x: lx.Section(1.0, 1.0, axial_stiffness=x), 1.0, POSITIVE),
    "Section: torsion": (lambda x: lx.Section(1.0, 1.0, torsional_stiffness=x), 1.0, POSITIVE),
    "Section: shear": (lambda x: lx.Section(1.0, 1.0, shear_stiffness=x), 1.0, POSITIVE),
    "Section: rotary inertia": (lambda x: lx.Section(1.0, 1.0, rotary_inertia=x), 0.0, NOT_NEGATIVE),
    "rectangle: width": (lambda x: lx.rectangle(x, 1.0, STEEL), 1.0, POSITIVE),
    "rectangle: height": (lambda x: lx.rectangle(1.0, x, STEEL), 1.0, POSITIVE),
    "rectangle: wall": (lambda x: lx.rectangle(1.0, 2.0, STEEL, x), 0.1, [*POSITIVE, 0.5]),
    "rectangle around a wall": (lambda x: lx.rectangle(x, 2.0, STEEL, 0.2), 1.0, [*POSITIVE, 0.4]),
    "circle: diameter": (lambda x: lx.circle(x, STEEL, 0.2), 1.0, [*POSITIVE, 0.4]),
    "circle: wall": (lambda x: lx.circle(1.0, STEEL, x), 0.1, [*POSITIVE, 0.5]),
    "beam: length": (lambda x: slender(length=x), 1.0, POSITIVE),
    "beam: damping": (lambda x: slender(damping=x), 0.0, NOT_NEGATIVE),
    "beam: inertia of what twists": (
        lambda x: slender(section=lx.Section(1.0, 1.0, 1.0, 1.0, rotary_inertia=x), torsion=True), 1.0, [0.0],
    ),
    "beam: place": (lambda x: slender().at(x, element=1), 0.5, [*NONE, 0.4, 1.1]),
    "beam: length around a place": (lambda x: (slender(length=x), slender(length=x).at(0.2, element=0)), 1.0, [0.3]),
    "Accuracy: rtol": (lambda x: lx.Accuracy(rtol=x), 1e-3, [*POSITIVE, 1e308]),
    "Accuracy: clearance": (lambda x: lx.Accuracy(clearance=x), 0.0, NOT_NEGATIVE),
    "Baumgarte": (lambda x: lx.Baumgarte(x, 1.0), 0.0, NOT_NEGATIVE),
    "Positive": (lx.Positive, np.ones(2), [[1.0, 0.0], [1.0, np.inf]]),
    "Bounded": (lambda x: lx.Bounded(x, 0.0, 1.0), 0.0, [*NOT_NEGATIVE, 2.0]),
    "PhysicalInertia": (lambda x: lx.PhysicalInertia(1.0, inertia=x), np.ones(3), [[1.0, 1.0, 2.0], [1.0, 1.0, -1.0]]),
}  # fmt: skip


SIZE = 8


@pytest.mark.parametrize("case", CASES)
def test_a_traced_number_that_cannot_be_is_marked(case):
    make, right, wrong = CASES[case]
    known = [np.asarray(leaf) for leaf in jax.tree.leaves(make(jnp.asarray(right)))]
    assert all(np.all(np.isfinite(leaf)) for leaf in known)
    for value in wrong:
        with pytest.raises(ValueError, match=r"(must|give|its|no body|use)"):
            make(jnp.asarray(value))
    rights = (SIZE - len(wrong)) * [right]  # of one size, so that operations are compiled once
    found = [np.asarray(leaf) for leaf in jax.tree.leaves(jax.vmap(make)(jnp.asarray([*rights, *wrong], float)))]
    for whole, leaf in zip(found, known, strict=True):
        for member in whole[: len(rights)]:
            np.testing.assert_allclose(member, leaf, rtol=1e-14)
    marked = [np.any(np.isnan(leaf.reshape(len(leaf), -1)), axis=1) for leaf in found]
    assert np.any(marked, axis=0).tolist() == len(rights) * [False] + len(wrong) * [True]


@pytest.mark.parametrize("case", ["body: inertia", "Universal: axis", "circle: wall", "beam: place"])
def test_a_check_leaves_the_derivative_by_a_traced_number(case):
    make, right, _ = CASES[case]
    slopes = jax.tree.leaves(jax.jacfwd(lambda x: jax.tree.leaves(make(x)))(jnp.asarray(right, float)))
    assert all(np.all(np.isfinite(slope)) for slope in slopes)
    assert any(np.any(slope != 0.0) for slope in slopes)


def test_every_element_is_among_the_cases():
    found = {type(make(jnp.asarray(right))).__name__ for make, right, _ in CASES.values()}
    kinds = (AbstractBody, AbstractConstraint, lx.AbstractForce, lx.AbstractJoint, lx.Section, lx.Material)
    of_kinds = [kind for kind in vars(lx).values() if inspect.isclass(kind) and issubclass(kind, kinds)]
    elements = {kind.__name__ for kind in of_kinds if not kind.__name__.startswith("Abstract")}
    assert elements - found == {"Drive", "Sliding"}  # which have no numbers of their own
