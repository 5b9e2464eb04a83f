"""Single precision: each element computes in it, whatever its own functions do, and as in double precision."""

import copy
import inspect
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx

LINK, LEG = lx.rod("link", 1.0, 1.0), lx.rod("leg", 1.0, 1.0)
TIP, FOOT, NAIL = LINK.at("tip"), LEG.at("tip"), lx.GROUND.at([0.5, 2.0, 0.1])
WHEEL, PLANE = LEG.at([0.5, 0.0, 0.0]), lx.GROUND.at([0.0, -0.2, 0.0])
# What users' functions compute with: numbers in double precision.
HALF, ASIDE = jnp.asarray(0.5), jnp.array([0.3, 0.5, 0.2])
LAW = lx.ContactLaw(stiffness=50.0, restitution=0.5, impact_speed=1.0)
HYDRAULIC = {"areas": (1e-3, 1e-3), "stroke": 4.0, "valve": 1e-8, "supply": 1e4, "dead_volume": 1e-4}
RAIL = {"radius": lambda y: HALF + 0.1 * y**2, "height": lambda y: -HALF * y**2, "span": [-0.2, 0.2]}
SECTION = lx.Section(20.0, 1.0, 1e3, 10.0, 1e3, rotary_inertia=0.01)
BOOM = lx.Beam("boom", 1.0, SECTION, elements=2)


class PushOfOnesOwn(lx.AbstractForce):
    display_name = "push"

    def load(self, t, motion):
        return lx.Load(*(jnp.ones_like(part, jnp.float64) for part in lx.Load.none(motion.system)))


AT_ENDS = {"parent": lx.GROUND, "child": LINK}
ALONG_AN_AXIS = lx.Prismatic, lx.Cylindrical, lx.Planar, lx.Rectangular, lx.Universal, lx.ConstantVelocity, lx.Revolute
# One element of each kind; what is along "pin" goes on a hinge or a slide.
ELEMENTS = [
    *(kind("pin", **AT_ENDS, axis="z") for kind in ALONG_AN_AXIS),
    *(kind("pin", **AT_ENDS) for kind in (lx.Spherical, lx.Fixed, lx.Free)),
    lx.Screw("pin", **AT_ENDS, axis="z", pitch=0.3),
    lx.Cam("pin", lx.GROUND, LINK, lambda angle: 1.0 + 0.1 * HALF * jnp.cos(angle)),
    lx.CurveJoint("pin", lx.GROUND, LINK, lambda u: ASIDE * u),
    lx.Sliding("sleeve", BOOM, LEG),
    lx.Distance("tie", NAIL, FOOT, 3.0),
    lx.Gravity([0.0, -9.81, 0.0]),
    lx.Spring(NAIL, FOOT, 3.0, 0.5),
    lx.Damper(NAIL, FOOT, 3.0),
    lx.PointForce(FOOT, lambda t, motion: ASIDE * jnp.cos(t)),
    lx.PointMoment(LEG, lambda t, motion: ASIDE),
    lx.ElasticRope([NAIL, TIP, FOOT], 3.0, 0.5, 0.1),
    lx.JointTorque("pin", lambda t, motion: HALF * motion.joint("pin")),
    lx.JointSpring("pin", 3.0, 0.2),
    lx.JointDamper("pin", 0.5),
    lx.JointFriction("pin", 0.5, 0.1),
    lx.JointInertia("pin", 0.5),
    lx.JointLimit("pin", LAW, lower=-1.0),
    lx.AffineActuator({"pin": 1.0}, lambda t, motion: HALF, gain=2.0, bias=[0.1, -1.0, -0.2]),
    lx.DCMotor("pin", lambda t, motion: HALF, resistance=1.0, inductance=0.1, constant=0.5),
    lx.PIDController("pin", lambda t, motion: HALF * t, proportional=3.0, integral=1.0, derivative=0.1),
    lx.FirstOrderSensor(lambda t, motion: HALF * motion.joint("pin"), 0.5),
    lx.LuGreFriction("pin", coulomb=1.0, static=1.5, stribeck_speed=0.1, stiffness=50.0, damping=1.0),
    lx.MaxwellElement(NAIL, FOOT, 3.0, 1.0, 0.5),
    lx.PneumaticSpring(NAIL, FOOT, area=1e-4, free_length=4.0, pressure=2e5),
    lx.HydraulicCylinder(NAIL, FOOT, lambda t, motion: HALF, closed=1.0, **HYDRAULIC),
    lx.HydraulicActuator("pin", lambda t, motion: HALF, closed=-2.0, **HYDRAULIC),
    lx.Contact(lx.Sphere(LEG, 0.3), lx.Plane(PLANE), LAW),
    lx.Clearance(lx.GROUND, LINK.at([0.1, 0.02, 0.0]), clearance=0.01, radius=0.5, law=LAW),
    lx.Impact("pin", lower=-1.0, restitution=0.5),
    lx.WheelRailContact(WHEEL, PLANE, **RAIL, law=LAW),
    PushOfOnesOwn(),
    lx.Coupling("gears", {"pin": 1.0, "knee": -2.0}),
    lx.PolynomialCoupling("curve", "knee", "pin", [0.0, 0.2, 0.1]),
    lx.Drive("motor", "pin", lambda t: HALF * t),
    lx.Rope("rope", [NAIL, FOOT], lambda t: 2.5 + 0.1 * HALF * t),
    lx.PointOnSurface("surface", FOOT, lx.GROUND, lambda x: ASIDE @ x),
    lx.Prescribed("lift", FOOT, lambda t: jnp.array([2.0, 0.0, 0.0]) + t * ASIDE),
    lx.Gear("gear", lx.GROUND, LEG, (20, 30)),
    lx.Rack("rack", LINK, PLANE, 20, 0.1),
    lx.RollingDisc("disc", WHEEL, PLANE, 0.2),
    lx.RollingSphere("ball", WHEEL, PLANE, 0.2),
    lx.Skate("edge", FOOT, PLANE),
    lx.WheelOnRail("wheel", WHEEL, PLANE, **RAIL),
]  # fmt: skip


def mechanism_with(element):
    """Two links on hinges with an element, on a slide what is hydraulic, and on a beam what slides there."""
    kind = lx.Prismatic if isinstance(element, lx.HydraulicActuator) else lx.Revolute
    pin, knee = kind("pin", **AT_ENDS, axis="z"), lx.Revolute("knee", TIP, LEG.at("base"), axis="z")
    gravity = lx.Gravity([0.0, -9.81, 0.0])
    if isinstance(element, lx.Sliding):
        return lx.Mechanism([BOOM, LEG], [lx.Fixed("weld", lx.GROUND, BOOM.at("base")), element], [gravity])
    if isinstance(element, lx.AbstractForce):
        return lx.Mechanism([LINK, LEG], [pin, knee], [gravity, element])
    if isinstance(element, lx.AbstractConstraint | lx.Distance):
        return lx.Mechanism([LINK, LEG], [pin, knee], [gravity], [element])
    return lx.Mechanism([LINK, LEG], [element, knee], [gravity])


def named(element):
    return "crowd" if element is None else type(element).__name__


@pytest.mark.parametrize("element", [None, *(pytest.param(one, marks=pytest.mark.slow) for one in ELEMENTS)], ids=named)
def test_each_element_computes_in_single_precision(element):
    """All that is computed, whether it closes or not: programs are traced alone, and types told; None for a crowd."""
    mechanism = crowd() if element is None else mechanism_with(element)
    q = np.zeros(mechanism.topology.num_coordinates)
    q[mechanism.topology.quaternions[:, 0]] = 1.0

    def read(state):
        found = lx.simulate(mechanism, state, t1=0.1, dtype=jnp.float32, throw=False)
        return found.ts, found.q, found.v, found.position("leg"), found.acceleration("leg"), found.kinetic_energy()

    with warnings.catch_warnings():
        warnings.simplefilter("error", FutureWarning)  # of doubles that are put among singles
        types = jax.eval_shape(read, lx.State(q, np.zeros(mechanism.topology.num_speeds)))
    assert {kind.dtype for kind in types} == {jnp.dtype(jnp.float32)}


def test_each_element_is_among_them():
    kinds = lx.AbstractForce, lx.AbstractConstraint, lx.AbstractJoint
    public = {name for name, kind in vars(lx).items() if inspect.isclass(kind) and issubclass(kind, kinds)}
    assert {name for name in public if not name.startswith("Abstract")} <= {*map(named, ELEMENTS)}


# Those that go on two links in closed positions; the others act on these beside all joints.
CLOSING = [
    element
    for element in ELEMENTS
    if isinstance(element, lx.Coupling | lx.PolynomialCoupling | lx.Drive | lx.Rope | lx.Distance)
]


def crowd():
    """All joints side by side, and all forces that hinges and points can have."""
    kinds = [element for element in ELEMENTS if isinstance(element, lx.AbstractJoint)]
    kinds = [joint for joint in kinds if not isinstance(joint, lx.Distance | lx.Sliding)]
    bodies = [LINK, LEG, *(lx.box(f"box {i}", [0.3, 0.2, 0.1], 1.0) for i in range(len(kinds)))]
    joints = [lx.Revolute("pin", lx.GROUND, LINK, axis="z"), lx.Revolute("knee", TIP, LEG.at("base"), axis="z")]
    for place, joint in enumerate(kinds):
        joint = copy.copy(joint)
        ends = lx.GROUND.at([0.1, 0.2, 0.0]), bodies[place + 2].at([0.3, 0.1, 0.0])
        for name, entry in (("name", f"joint {place}"), ("parent", ends[0]), ("child", ends[1])):
            object.__setattr__(joint, name, entry)
        joints.append(joint)
    forces = [element for element in ELEMENTS if isinstance(element, lx.AbstractForce)]
    rough = lx.HydraulicActuator, lx.Impact, lx.WheelRailContact, PushOfOnesOwn
    return lx.Mechanism(bodies, joints, [force for force in forces if not isinstance(force, rough)])


@pytest.mark.slow
@pytest.mark.parametrize("element", [None, *CLOSING], ids=named)
def test_single_precision_has_five_digits(element):
    mechanism = crowd() if element is None else mechanism_with(element)
    start = lx.assemble(mechanism, guess={"pin": -0.3, "knee": 0.2})
    options = {"t1": 0.05, "accuracy": lx.Accuracy(rtol=1e-6)}
    single, double = (lx.simulate(mechanism, start, dtype=dtype, **options) for dtype in (jnp.float32, jnp.float64))
    assert single.q.dtype == single.v.dtype == jnp.float32
    for name in ("q", "v"):
        found, right = np.asarray(getattr(single, name)[-1]), np.asarray(getattr(double, name)[-1])
        np.testing.assert_allclose(found, right, atol=1e-5 * np.max(np.abs(right)))
