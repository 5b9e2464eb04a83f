"""Mechanisms built again and again, with functions in them that are made anew each time."""

import threading

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from mechanisms import pendulum

import linkax as lx
from linkax.model.mechanism import require_unchanged

HINGE = ("hinge", lx.GROUND)


def turned(numbers):
    """Angle of a rotor of inertia one after a second, by functions of these numbers."""
    rotor = lx.RigidBody("rotor", 1.0, [0.0, 0.0, 0.0], jnp.ones(3))
    torque, moment, force = numbers
    forces = [
        lx.JointTorque("hinge", lambda t, motion: torque * t),
        lx.PointMoment(rotor, lambda t, motion: jnp.array([0.0, 0.0, moment])),
        lx.PointForce(rotor.at([1.0, 0.0, 0.0]), lambda t, motion: jnp.array([0.0, force, 0.0]), axes="frame"),
    ]
    mechanism = lx.Mechanism([rotor], [lx.Revolute(*HINGE, rotor, "z")], forces)
    event = diffrax.Event(lambda t, state, mechanism: state.q[0] - 100.0 * torque)
    saveat = diffrax.SaveAt(t1=True, fn=lambda t, state, mechanism: state.q[0])
    start = lx.State(jnp.zeros(1), jnp.zeros(1))
    found = lx.simulate(mechanism, start, t1=1.0, saveat=saveat, event=event)
    return found.ys[-1]


def moved(numbers):
    """Coordinates and speeds of a driven arm and of a load on a winch, at 0.1 s, by functions of these numbers."""
    arm, load = lx.rod("arm", 1.0, 1.0), lx.point_mass("load", 1.0)
    joints = [lx.Revolute(*HINGE, arm.at("base"), "z"), lx.Prismatic("lift", lx.GROUND, load, "y")]
    constraints = [
        lx.Drive("motor", "hinge", lambda t: numbers[0] * jnp.sin(numbers[1] * t)),
        lx.Rope("winch", [lx.GROUND.at([0.0, 4.0, 0.0]), load], lambda t: 4.0 - numbers[2] * t**2),
    ]
    mechanism = lx.Mechanism([arm, load], joints, constraints=constraints)
    state = lx.assemble(mechanism, t=0.1)
    return jnp.concatenate([state.q, state.v])


NUMBERS, HALVES = jnp.array([0.7, 3.0, 2.0]), jnp.array([0.35, 1.5, 1.0])
EXACT = {
    turned: lambda numbers: numbers[0] / 6.0 + numbers[1] / 2.0 + numbers[2] / 2.0,
    moved: lambda numbers: jnp.stack(
        [
            numbers[0] * jnp.sin(0.1 * numbers[1]),
            0.01 * numbers[2],
            numbers[0] * numbers[1] * jnp.cos(0.1 * numbers[1]),
            0.2 * numbers[2],
        ]
    ),
}


@pytest.mark.parametrize("of", EXACT, ids=lambda of: of.__name__)
def test_functions_made_anew_compile_nothing(of):
    with compilations() as begun:
        first = of(NUMBERS)
    with compilations() as compiled:
        again, other = of(NUMBERS), of(HALVES)
    assert begun
    assert not compiled
    np.testing.assert_array_equal(again, first)
    for found, numbers in ((first, NUMBERS), (other, HALVES)):
        np.testing.assert_allclose(found, EXACT[of](numbers), rtol=1e-7)


@pytest.mark.slow
def test_derivatives_by_an_array_that_drives_close_over():
    found, step = jax.jit(jax.jacfwd(moved))(NUMBERS), 1e-5
    np.testing.assert_allclose(found, jax.jacfwd(EXACT[moved])(NUMBERS), atol=1e-12)
    differences = [(moved(NUMBERS + along) - moved(NUMBERS - along)) / (2.0 * step) for along in step * jnp.eye(3)]
    np.testing.assert_allclose(found, np.stack(differences, axis=1), atol=1e-8)


def cruised(speed, start):
    """Angle and speed after half a second of an arm that turns at constant speed."""
    mechanism = pendulum(gravity=0.0, constraints=[lx.Drive("motor", "hinge", speed=speed, start=start)])
    found = lx.simulate(mechanism, lx.assemble(mechanism), t1=0.5, saveat=diffrax.SaveAt(t1=True))
    return jnp.array([found.q[-1, 0], found.v[-1, 0]])


def test_another_constant_speed_compiles_nothing():
    first = cruised(6.0, 0.3)
    with compilations() as compiled:
        other = cruised(-2.0, 1.5)
    assert not compiled
    np.testing.assert_allclose(first, [3.3, 6.0], rtol=1e-13)
    np.testing.assert_allclose(other, [0.5, -2.0], rtol=1e-13)


@pytest.mark.slow
def test_derivatives_by_a_constant_speed():
    by_speed, by_start = jax.jit(jax.jacfwd(cruised, (0, 1)))(6.0, 0.3)
    np.testing.assert_allclose([by_speed, by_start], [[0.5, 1.0], [1.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize("moves", [True, False])
def test_a_drive_at_constant_speed_goes_on_or_is_held(moves):
    drive = lx.Drive("motor", "hinge", speed=6.0, start=0.3)
    held = drive.held(0.2, jnp.asarray(moves))
    at_zero = drive.attached({}, {"hinge": jnp.zeros(1)}, ())
    np.testing.assert_allclose(held.residual(1.0, at_zero), -6.3 if moves else -1.5, rtol=1e-15)
    np.testing.assert_allclose(drive.held(0.2).residual(1.0, at_zero), -1.5, rtol=1e-15)


TORQUE = 5.0


class Constant(lx.AbstractForce):
    joint: str = eqx.field(static=True)
    of: object = eqx.field(static=True, default=None)

    @property
    def terms(self):
        return (lx.Term(self.joint, None),)

    def load(self, t, motion):
        return motion.joint_load(self.terms[0], jnp.asarray(TORQUE if self.of is None else self.of.torque))


class Read:
    def __init__(self):
        self.torque = TORQUE


class Making(Constant):
    def load(self, t, motion):
        return motion.joint_load(self.terms[0], jnp.asarray(Read().torque))


class Law(lx.ContactLaw):
    def elastic_force(self, depth):
        return TORQUE * depth


class Held(lx.AbstractConstraint):
    units = ("rad",)
    hinge: str = eqx.field(static=True, default="hinge")

    @property
    def joints(self):
        return (self.hinge,)

    def residual(self, t, attached):
        return attached.joint(self.hinge) - TORQUE


class Hinge(lx.AbstractJoint):
    speed_units = ("rad",)

    def transform(self, coordinates):
        axis = jnp.array([TORQUE / TORQUE, 0.0, 0.0])
        return jax.scipy.linalg.expm(coordinates[0] * jnp.cross(axis, jnp.eye(3))), jnp.zeros(3)


class Settings:
    def __init__(self):
        self.torque, self.unread = 5.0, None


SETTINGS = Settings()
ARM = lx.rod("arm", 1.0, 1.0)
OWN = {
    "a force": lambda: pendulum(forces=[Constant("hinge")]),
    "a field of a force": lambda: pendulum(forces=[Constant("hinge", SETTINGS)]),
    "an object that a force makes": lambda: pendulum(forces=[Making("hinge")]),
    "a part of a force": lambda: pendulum(
        forces=[lx.Contact(lx.Sphere(ARM.at("tip"), 0.1), lx.Plane(lx.GROUND), Law(1e5))]
    ),
    "a constraint": lambda: pendulum(constraints=[Held("held")]),
    "a joint": lambda: lx.Mechanism([ARM], [Hinge("hinge", lx.GROUND, ARM.at("base"), "z")]),
}


@pytest.mark.parametrize("build", OWN.values(), ids=OWN)
def test_a_mechanism_whose_elements_read_what_has_changed_is_refused(build, monkeypatch):
    mechanism, again = build(), build()
    assert mechanism.own_classes
    assert mechanism.own_classes == again.own_classes
    SETTINGS.unread = object()
    lx.State.as_drawn(mechanism)
    require_unchanged(mechanism)
    monkeypatch.setitem(globals(), "TORQUE", 50.0)
    monkeypatch.setattr(SETTINGS, "torque", 50.0)
    with pytest.raises(ValueError, match=r"\w+: what this class reads \(.*TORQUE.*\) has changed .* anew"):
        lx.assemble(mechanism)
    assert build().own_classes != mechanism.own_classes


def test_a_number_that_an_element_reads_is_that_of_now(monkeypatch):
    build = OWN["a force"]
    of_state = lambda mechanism: lx.Solution.of_state(mechanism, lx.State.as_drawn(mechanism))
    accelerated = lambda: float(of_state(build()).joint_acceleration("hinge")[0])
    first = accelerated()
    with compilations() as compiled:
        assert accelerated() == first
    assert not compiled
    monkeypatch.setitem(globals(), "TORQUE", 50.0)
    np.testing.assert_allclose(accelerated() - first, 45.0 * 3.0, rtol=1e-13)  # inertia of a rod: m l² / 3


def test_elements_that_read_what_cannot_be_compared_are_refused():
    with pytest.raises(ValueError, match=r"own reads Constant, a _thread\.lock, which cannot be compared; .* let it"):
        pendulum(forces=[Constant("hinge", threading.Lock())])


def test_a_mechanism_whose_functions_have_changed_is_refused():
    speeds = {"motor": 2.0}
    build = lambda: pendulum(constraints=[lx.Drive("motor", "hinge", lambda t: speeds["motor"] * t)])
    mechanism, now = build(), lambda mechanism: mechanism.constraints[0].right_side(0.5)
    assert now(mechanism) == 1.0
    speeds["motor"] = 3.0
    run = lambda mechanism: lx.simulate(mechanism, lx.State(jnp.zeros(1), jnp.zeros(1)), t1=1.0)
    for use in (now, lx.assemble, run):
        with pytest.raises(ValueError, match=r"drive 'motor': what its function reads \(speeds\) has changed .* anew"):
            use(mechanism)
    assert now(build()) == 1.5
