"""Every message on bad input names the element, the value and the remedy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import crank_slider, pendulum
from refusals import refused

import linkax as lx
from linkax.scenes import SCENES


def body(name="part", mass=1.0, inertia=(1.0, 1.0, 1.0), **options):
    return lx.RigidBody(name, mass, inertia=inertia, **options)


STEEL = lx.Material(2.1e11, 0.3, 7850.0)


def slender(section=None, **options):
    section = lx.Section(1.0, 1.0) if section is None else section
    return lx.Beam("boom", 1.0, section, torsion=False, stretch=False, **options)


BAD = {
    "negative mass": (lambda: body(mass=-2.0), ["'part'", "-2.0", "zero or more"]),
    "mass not a number": (lambda: body(mass=float("nan")), ["'part'", "nan", "finite"]),
    "infinite mass": (lambda: body(mass=np.inf), ["'part'", "inf", "finite"]),
    "mass as text": (lambda: body(mass="heavy"), ["'part'", "'heavy'", "must be a number"]),
    "mass of two": (lambda: body(mass=[1.0, 2.0]), ["'part'", "(2,)", "single number"]),
    "triangle inequality": (lambda: body(inertia=(1.0, 1.0, 3.0)), ["'part'", "3.0", "triangle inequality"]),
    "negative inertia": (lambda: body(inertia=(1.0, 1.0, -0.1)), ["'part'", "-0.1", "must not be negative"]),
    "asymmetric inertia": (lambda: body(inertia=np.eye(3) + 0.1 * np.eye(3, k=1)), ["'part'", "0.1", "symmetric"]),
    "inertia of wrong shape": (lambda: body(inertia=np.eye(2)), ["'part'", "(2, 2)", "(3, 3)"]),
    "center of mass of wrong shape": (lambda: body(center_of_mass=[0.0, 1.0]), ["'part'", "(2,)", "(3,)"]),
    "named ground": (lambda: body("ground"), ["'ground'", "lx.GROUND", "choose another"]),
    "no name": (lambda: body(""), ["''", "non-empty"]),
    "rod of no length": (lambda: lx.rod("bar", 0.0, 1.0), ["'bar'", "0.0", "positive"]),
    "rod of negative mass": (lambda: lx.rod("bar", 1.0, -1.0), ["'bar'", "-1.0", "zero or more"]),
    "flat box": (lambda: lx.box("crate", [1.0, 0.0, 1.0], 1.0), ["'crate'", "0.0", "positive"]),
    "unknown frame": (lambda: lx.rod("bar", 1.0, 1.0).at("end"), ["'bar'", "'end'", "'base', 'tip'"]),
    "offset of wrong shape": (lambda: body().at([1.0, 2.0]), ["'part'", "(2,)", "(3,)"]),
    "rotation not orthonormal": (lambda: body().at([0, 0, 0], 2 * np.eye(3)), ["'part'", "2.0", "orthonormal"]),
    "left-handed rotation": (lambda: body().at([0, 0, 0], np.diag([1, 1, -1])), ["'part'", "-1.0", "right-handed"]),
    "zero axis": (lambda: lx.Revolute("pin", lx.GROUND, body(), [0, 0, 0]), ["'pin'", "0.0", "nonzero vector"]),
    "zero axis as a JAX array": (
        lambda: lx.Revolute("pin", lx.GROUND, body(), jnp.zeros(3)),
        ["'pin'", "0.0", "nonzero vector"],
    ),
    "unknown axis": (lambda: lx.Revolute("pin", lx.GROUND, body(), "w"), ["'pin'", "'w'", "x, -x, y"]),
    "axis of wrong shape": (lambda: lx.Prismatic("pin", lx.GROUND, body(), [1, 0]), ["'pin'", "(2,)", "(3,)"]),
    "joint with a name": (lambda: lx.Revolute("pin", "part", body(), "z"), ["'pin'", "'part'", "body.at"]),
    "joint without a name": (lambda: lx.Revolute("", lx.GROUND, body(), "z"), ["''", "non-empty"]),
    "gravity of wrong shape": (lambda: lx.Gravity(9.81), ["Gravity", "()", "(3,)"]),
    "screw without a pitch": (lambda: lx.Screw("nut", lx.GROUND, body(), "x", 0.0), ["'nut'", "0.0", "lx.Revolute"]),
    "distance of zero": (lambda: lx.Distance("rope", lx.GROUND, body(), 0.0), ["'rope'", "0.0", "lx.Spherical"]),
    "section that resists nothing": (lambda: lx.Section(0.0, 1.0), ["bending_stiffness", "0.0", "positive"]),
    "section of negative weight": (lambda: lx.Section(1.0, -1.0), ["linear_density", "-1.0", "positive"]),
    "material that no solid is": (lambda: lx.Material(1e9, 0.7, 1.0), ["poissons_ratio", "0.7", "(-1, 0.5]"]),
    "walls too thick": (lambda: lx.rectangle(0.1, 0.2, STEEL, 0.05), ["thickness", "0.05", "less than half"]),
    "tube of walls alone": (lambda: lx.circle(0.1, STEEL, 0.06), ["thickness", "0.06", "less than half"]),
    "beam of no section": (lambda: lx.Beam("boom", 1.0, 3.0), ["'boom'", "3.0", "lx.Section"]),
    "beam of no length": (lambda: lx.Beam("boom", 0.0, lx.Section(1.0, 1.0)), ["'boom'", "0.0", "positive"]),
    "beam of no elements": (lambda: slender(elements=0), ["'boom'", "0", "at least 1"]),
    "beam that bends about x": (lambda: slender(bends="x"), ["'boom'", "'x'", "'yz'"]),
    "beam that is rigid": (lambda: slender(bends=""), ["'boom'", "lx.rod"]),
    "beam that twists without stiffness": (
        lambda: lx.Beam("boom", 1.0, lx.Section(1.0, 1.0)),
        ["'boom'", "torsional_stiffness", "leave that strain out"],
    ),
    "beam that twists without inertia": (
        lambda: lx.Beam("boom", 1.0, lx.Section(1.0, 1.0, torsional_stiffness=1.0), stretch=False),
        ["'boom'", "rotary_inertia", "axial_stiffness"],
    ),
    "beam that shears without inertia": (
        lambda: slender(section=lx.Section(1.0, 1.0, shear_stiffness=1.0), shear=True),
        ["'boom'", "rotary_inertia", "axial_stiffness"],
    ),
    "beam with negative damping": (lambda: slender(damping=-1.0), ["'boom'", "damping", "-1.0"]),
    "unknown place on a beam": (lambda: slender().at("middle"), ["'boom'", "'middle'", "'tip'"]),
    "place of unknown distance": (
        lambda: jax.jit(lambda x: slender().at(x).offset)(0.5),
        ["'boom'", "traced", "element="],
    ),
    "place in an unknown element": (lambda: slender().at(0.5, element=8), ["'boom'", "8", "at most 7"]),
    "place beyond the tip": (lambda: slender().at(1.7), ["'boom'", "1.7", "from 0.0 m to 1.0 m"]),
    "place before the base": (lambda: slender().at([-0.1, 0, 0]), ["'boom'", "-0.1", "from 0.0 m to 1.0 m"]),
    "place in another element": (lambda: slender().at(0.5, element=0), ["'boom'", "0.5", "from 0.0 m to 0.125 m"]),
    "sleeve on a rigid body": (lambda: lx.Sliding("sleeve", body(), body("other")), ["'sleeve'", "lx.Beam"]),
    "coupling of nothing": (lambda: lx.Coupling("gears", {}), ["'gears'", "{}", "factor"]),
    "coupling by zero": (lambda: lx.Coupling("gears", {"pin": 0.0}), ["'gears'", "0.0", "not zero"]),
    "coupling of a number": (lambda: lx.Coupling("gears", {3: 1.0}), ["'gears'", "3", "name of a joint"]),
    "curve of one number": (
        lambda: lx.PolynomialCoupling("curve", "pin", "knee", [1.0]),
        ["'curve'", "(1,)", "two or more"],
    ),
    "curve of nothing": (
        lambda: lx.PolynomialCoupling("curve", "pin", {}, [0.0, 1.0]),
        ["'curve'", "of is {}", "give"],
    ),
    "drive by a number": (lambda: lx.Drive("motor", "pin", 2.0), ["'motor'", "2.0", "function of time", "speed="]),
    "drive without motion": (lambda: lx.Drive("motor", "pin"), ["'motor'", "no motion", "speed="]),
    "drive by two laws": (lambda: lx.Drive("motor", "pin", jnp.sin, speed=2.0), ["'motor'", "speed is 2.0", "one of"]),
    "drive by a law from a start": (lambda: lx.Drive("motor", "pin", jnp.sin, start=0.1), ["start is 0.1", "one of"]),
    "drive at two speeds": (lambda: lx.Drive("motor", "pin", speed=[1.0, 2.0]), ["'motor'", "speed", "(2,)", "single"]),
    "drive at a speed in text": (lambda: lx.Drive("motor", "pin", speed="fast"), ["'motor'", "speed is 'fast'"]),
    "drive by a vector": (lambda: lx.Drive("motor", "pin", lambda t: t * jnp.ones(2)), ["'motor'", "(2,)", "single"]),
    "spring on one body": (lambda: lx.Spring(body().at([1, 0, 0]), body(), 1.0), ["Spring", "'part'", "two bodies"]),
    "spring of negative length": (lambda: lx.Spring(lx.GROUND, body(), 1.0, -1.0), ["Spring", "'part'", "-1.0"]),
    "friction without a scale": (lambda: lx.JointFriction("pin", 1.0, 0.0), ["'pin'", "scale", "positive"]),
    "inertia below zero": (lambda: lx.JointInertia("pin", -1.0), ["'pin'", "inertia", "-1.0"]),
    "actuator of nothing": (lambda: lx.AffineActuator({}), ["AffineActuator", "transmission is {}", "give"]),
    "actuator by zero": (lambda: lx.AffineActuator({"pin": 0.0}), ["transmission", "[0.0]", "not zero"]),
    "actuator with two gains": (lambda: lx.AffineActuator("pin", gain=[1.0, 2.0]), ["'pin'", "gain", "(2,)", "(3,)"]),
    "actuator between wrong limits": (
        lambda: lx.AffineActuator("pin", force_range=[1.0, -1.0], name="servo"),
        ["'servo'", "force_range", "[1.0, -1.0]", "above"],
    ),
    "force in unknown axes": (lambda: lx.PointForce(body(), [1, 0, 0], "body"), ["'part'", "'body'", "'frame'"]),
    "rectangle of no material": (lambda: lx.rectangle(0.1, 0.2, 3.0), ["rectangle", "3.0", "lx.Material"]),
    "circle of no material": (lambda: lx.circle(0.1, "steel"), ["circle", "'steel'", "lx.Material"]),
    "rope over a number": (lambda: lx.Rope("hoist", np.nan, 1.0), ["'hoist'", "points", "nan", "list of bodies"]),
    "rope over one body": (lambda: lx.ElasticRope(body(), 1.0, 1.0), ["ElasticRope", "points", "list of bodies"]),
    "rope over a name": (lambda: lx.ElasticRope(["part", body()], 1.0, 1.0), ["ElasticRope", "'part'", "bodies"]),
    "force on the ground": (lambda: lx.PointForce(lx.GROUND, [1, 0, 0]), ["PointForce", "'ground'", "nothing moves"]),
    "moment on the ground": (
        lambda: lx.PointMoment(lx.GROUND.at([1, 0, 0]), [1, 0, 0]),
        ["PointMoment", "'ground'", "nothing moves"],
    ),
    "spring on the ground": (lambda: lx.Spring(lx.GROUND, lx.GROUND, 1.0), ["Spring", "'ground'", "two bodies"]),
    "damper on the ground": (lambda: lx.Damper(lx.GROUND, lx.GROUND, 1.0), ["Damper", "'ground'", "two bodies"]),
    "rope on the ground": (
        lambda: lx.ElasticRope([lx.GROUND, lx.GROUND], 1.0, 1.0),
        ["ElasticRope", "'ground'", "two bodies"],
    ),
    "torque that is not finite": (lambda: lx.JointTorque("pin", np.inf), ["'pin'", "inf", "finite"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_element(case):
    build, words = BAD[case]
    with pytest.raises(ValueError, match=r".") as error:
        build()
    for word in words:
        assert word in str(error.value)


LINK, OTHER = lx.rod("link", 1.0, 1.0), lx.rod("other", 1.0, 1.0)
PIN = lx.Revolute("pin", lx.GROUND, LINK.at("base"), "z")
BOOM = slender()


def test_bad_mechanisms_of_beams():
    joints = [lx.Fixed("foot", lx.GROUND, BOOM), lx.Revolute("pin", lx.GROUND, body("boom"), "z")]
    refused(lambda: lx.Mechanism([BOOM, body("boom")], joints), "'boom'", "2 times", "of its own")
    refused(lambda: lx.Mechanism([LINK, BOOM], [PIN]), "connects 'boom' to ground", "join")
    joints = [PIN, lx.Fixed("foot", LINK, BOOM), *(lx.Sliding(name, BOOM, OTHER) for name in ("sleeve", "shoe"))]
    two_sleeves_on_one_body = lambda: lx.Mechanism([LINK, OTHER, BOOM], joints)
    refused(two_sleeves_on_one_body, "'shoe'", "slides along a beam", "massless body")


def test_axes_are_normalised_and_static_unless_traced():
    structure = lambda axis: jax.tree.structure(lx.Revolute("pin", lx.GROUND, LINK, axis))
    assert structure("z") == structure((0, 0, 2)) == structure([0.0, 0.0, 1.0]) == structure(np.array([0, 0, 5.0]))
    assert structure("z") != structure("x")
    traced = [lx.Revolute("pin", lx.GROUND, LINK, jnp.array(axis)) for axis in ([0.0, 0.0, 2.0], [1.0, 0.0, 0.0])]
    assert jax.tree.structure(traced[0]) == jax.tree.structure(traced[1]) != structure("z")
    np.testing.assert_allclose(traced[0].axis, [0.0, 0.0, 1.0])


RELATED = {
    "drive of a ball": (lx.Drive("motor", "ball", jnp.sin), ["'motor'", "'ball'", "3 speeds"]),
    "drive of a ball at constant speed": (lx.Drive("motor", "ball", speed=1.0), ["'motor'", "'ball'", "3 speeds"]),
    "drive of a turning ball": (lx.Drive("motor", ("ball", 1), jnp.sin), ["'motor'", "'ball'", "quaternion"]),
    "curve of a turning ball": (
        lx.PolynomialCoupling("curve", "pin", {("ball", 1): 2.0}, [0.0, 1.0, 2.0]),
        ["'curve'", "'ball'", "quaternion", "another"],
    ),
    "spring on a ball": (lx.JointSpring(("ball", 0), 1.0), ["'ball'", "JointSpring", "quaternion", "another"]),
    "servo on a ball": (lx.AffineActuator({("ball", 2): 0.5}), ["'ball'", "AffineActuator", "quaternion", "another"]),
    "spring to a body that is not there": (lx.Spring(LINK, body("absent"), 1.0), ["Spring", "'absent'", "add"]),
}


@pytest.mark.parametrize("case", RELATED)
def test_bad_constraint_or_force(case):
    element, words = RELATED[case]
    joints = [PIN, lx.Revolute("far", lx.GROUND, LINK.at("tip"), "z", cut=True), lx.Spherical("ball", LINK, OTHER)]
    place = "forces" if isinstance(element, lx.AbstractForce) else "constraints"
    refused(lambda: lx.Mechanism([LINK, OTHER], joints, **{place: [element]}), *words)


def test_other_numbers_are_the_same_structure():
    assert jax.tree.structure(pendulum(1.0)) == jax.tree.structure(pendulum(2, mass=3))
    assert all(hasattr(leaf, "dtype") for leaf in jax.tree.leaves(pendulum(1.0)))


def test_mechanisms_are_built_under_transformations():
    tip = lambda length: pendulum(length).body("arm").frames["tip"][0]
    np.testing.assert_allclose(jax.grad(lambda length: tip(length) ** 2)(3.0), 6.0)
    np.testing.assert_allclose(jax.vmap(tip)(jnp.array([1.0, 2.0])), [1.0, 2.0])
    np.testing.assert_allclose(jax.jit(tip)(1.5), 1.5)


def test_the_tree_grows_breadth_first_and_is_described():
    for order in (1, -1):
        topology = crank_slider(order=order).topology
        assert {"bearing", "guide"} <= set(topology.coordinates)
        assert topology.num_cuts == 1
    pushed = crank_slider(forces=[lx.JointTorque("wrist_pin", 1.0)]).topology
    assert "wrist_pin" in pushed.coordinates
    assert "cut  Prismatic" in pushed.describe()
    assert "tree Revolute 'wrist_pin'" in pushed.describe()


def test_a_traced_axis_drops_no_row():
    def loop(axis):
        arm, rod = lx.rod("arm", 1.0, 1.0), lx.rod("rod", 1.0, 1.0)
        joints = [
            lx.Revolute("a", lx.GROUND, arm.at("base"), axis),
            lx.Revolute("b", lx.GROUND.at([1, 0, 0]), rod.at("base"), axis),
            lx.Revolute("c", arm.at("tip"), rod.at("tip"), axis, cut=True),
        ]
        return lx.Mechanism([arm, rod], joints).topology.num_rows

    assert loop("z") == loop((0.0, 1.0, 1.0)) == 2
    assert loop(jnp.array([0.0, 0.0, 1.0])) == 5


def test_a_mechanism_keeps_its_numbers():
    inertia, offset = np.eye(3), np.array([0.0, 0.0, 0.5])
    body = lx.RigidBody("link", mass=1.0, inertia=inertia, frames={"tip": offset})
    inertia *= 3.0
    offset *= 3.0
    np.testing.assert_array_equal(body.inertia, np.eye(3))
    np.testing.assert_array_equal(body.frames["tip"], [0.0, 0.0, 0.5])
    with pytest.raises(ValueError, match="read-only"):
        body.inertia[0, 0] = 2.0


class Push(lx.AbstractForce):
    """Of which NumPy has the numbers."""

    frame: lx.Frame
    force: np.ndarray

    @property
    def frames(self):
        return (self.frame,)

    def load(self, t, motion):
        return motion.point_load(self.frame, self.force)


def test_arrays_of_mechanisms_cannot_be_written_to():
    arm, force = lx.rod("arm", 1.0, 1.0), np.zeros(3)
    pushed = lx.Mechanism([arm], [lx.Revolute("hinge", lx.GROUND, arm, "z")], [Push(arm.at("tip"), force)])
    force[0] = 1.0
    assert np.all(pushed.forces[0].force == 0.0)
    for mechanism in (pushed, *(scene.mechanism(scene.settings()) for scene in SCENES.values())):
        for leaf in jax.tree.leaves(mechanism):
            assert not isinstance(leaf, np.ndarray) or not leaf.flags.writeable
