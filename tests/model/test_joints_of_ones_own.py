"""Joints that a user writes, by a transform, in the tree and closing loops."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx


class Helix(lx.AbstractJoint):
    """A nut on a helix of a radius and a rise per radian; its axes turn with it."""

    speed_units = ("rad",)

    radius: float
    rise: float
    turns: bool = eqx.field(static=True)

    def __init__(self, name, parent, child, radius, rise, *, turns=True, cut=False):
        super().__init__(name, parent, child, "x", cut=cut)
        self.radius, self.rise, self.turns = radius, rise, turns

    def transform(self, coordinates):
        (angle,) = coordinates
        c, s, zero, one = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle), jnp.ones_like(angle)
        turned = jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)
        place = jnp.stack([self.radius * (c - 1.0), self.radius * s, self.rise * angle])
        return turned if self.turns else jnp.eye(3), place


def sliding(radius, rise=0.1, **options):
    bead = lx.RigidBody("bead", 2.0, inertia=[0.01, 0.01, 0.01])
    return lx.Mechanism(
        [bead], [Helix("wire", lx.GROUND, bead, radius, rise, **options)], [lx.Gravity([0.0, 0.0, -9.81])]
    )


@pytest.mark.parametrize("turns", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_down_a_helix(turns):
    """φ̈ = −m g h / (m (r² + h²) + I); the reaction is m (a − g) with a = −r φ̇² n + φ̈ (r t + h z)."""
    mechanism = sliding(0.3, turns=turns)
    found = lx.simulate(mechanism, lx.State.as_drawn(mechanism), t1=1.0, accuracy=lx.PRECISE)
    ts, inertia = np.asarray(found.ts), 0.01 if turns else 0.0
    rate = -2.0 * 9.81 * 0.1 / (2.0 * (0.09 + 0.01) + inertia)
    np.testing.assert_allclose(found.joint("wire"), rate * ts**2 / 2.0, atol=1e-10)
    np.testing.assert_allclose(found.energy(), 0.0, atol=1e-9)
    angle = rate * ts**2 / 2.0
    c, s = np.cos(angle), np.sin(angle)
    inward, along = -np.stack([c, s, 0.0 * s], -1), np.stack([-s, c, 0.0 * s], -1)
    acceleration = 0.3 * ((rate * ts) ** 2)[:, None] * inward + rate * (0.3 * along + [0.0, 0.0, 0.1])
    np.testing.assert_allclose(
        found.reaction("wire").force, 2.0 * acceleration + np.array([0.0, 0.0, 19.62]), atol=1e-7
    )


def closed(radius):
    """The bead of a helix between the ends of an arm and the world: its joint closes a loop."""
    arm = lx.RigidBody("arm", 1.0, [0.1, 0.0, 0.0], [0.02, 0.03, 0.04])
    bead = lx.RigidBody("bead", 2.0, inertia=[0.01, 0.01, 0.01])
    joints = [
        lx.Cylindrical("axle", lx.GROUND, arm, "z"),
        lx.Fixed("tip", arm.at([0.3, 0.0, 0.0]), bead),
        Helix("wire", lx.GROUND.at([0.3, 0.0, 0.0]), bead, radius, 0.1),
    ]
    return lx.Mechanism([arm, bead], joints, [lx.Gravity([0.0, 0.0, -9.81])])


@pytest.mark.slow
def test_in_a_loop():
    mechanism = closed(0.3)
    state = lx.assemble(mechanism, {"wire": 7.0})
    assert lx.mobility(mechanism, state).degrees_of_freedom == 1
    found = lx.simulate(mechanism, state, t1=1.0)
    np.testing.assert_allclose(found.joint("wire")[0], 7.0, atol=1e-12)
    rate = -3.0 * 9.81 * 0.1 / (3.0 * 0.01 + 2.0 * 0.09 + 0.04 + 0.01 + 0.01)
    np.testing.assert_allclose(found.joint("wire"), 7.0 + rate * found.ts**2 / 2.0, rtol=1e-9)


@pytest.mark.slow
def test_derivatives():
    reached = lambda radius: lx.simulate(
        sliding(radius), lx.assemble(sliding(radius)), t1=1.0, saveat=diffrax.SaveAt(t1=True)
    ).q[0, 0]
    exact = 9.81 * 0.1 / (2.0 * (0.09 + 0.015) ** 2) * 2.0 * 0.3
    np.testing.assert_allclose([jax.grad(reached)(0.3), jax.jacfwd(reached)(0.3)], exact, rtol=1e-9)


class BallOnCircle(lx.AbstractJoint):
    """A ball whose centre stays on a circle, and that turns freely: a quaternion and an angle."""

    speed_units = ("rad", "rad", "rad", "rad")
    has_quaternion = True

    radius: float

    def __init__(self, name, parent, child, radius, *, cut=False):
        super().__init__(name, parent, child, "x", cut=cut)
        self.radius = radius

    def transform(self, coordinates):
        w, x, y, z, angle = coordinates
        turned = jnp.array(
            [
                [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
                [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
                [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
            ]
        )
        return turned, self.radius * jnp.stack([jnp.cos(angle), 0.0 * angle, jnp.sin(angle)])


@pytest.mark.slow
def test_coordinates_that_are_a_quaternion():
    """Off its centre of mass, as a ball on a massless arm from a hinge: two models of one motion."""
    top = lambda: lx.RigidBody("top", 2.0, [0.05, 0.02, 0.1], [0.02, 0.03, 0.04])
    own = lx.Mechanism([top()], [BallOnCircle("slot", lx.GROUND, top(), 0.3)], [lx.Gravity([0.0, 0.0, -9.81])])
    arm = lx.RigidBody("arm", 0.0)
    joints = [
        lx.Revolute("hinge", lx.GROUND, arm, "-y"),
        lx.Spherical("ball", arm.at([0.3, 0.0, 0.0]), top()),
    ]
    other = lx.Mechanism([arm, top()], joints, [lx.Gravity([0.0, 0.0, -9.81])])
    omega = jnp.array([0.4, -1.1, 2.0])
    begin = lx.State(jnp.array([1.0, 0.0, 0.0, 0.0, -0.4]), jnp.array([*omega, 0.7]))
    found = lx.simulate(own, begin, t1=1.0, accuracy=lx.PRECISE)
    begin = lx.assemble(
        other,
        {"hinge": -0.4, "top": lx.Pose(found.position("top", [0.0, 0.0, 0.0])[0], np.eye(3))},
        {"hinge": 0.7, "top": lx.Velocity(angular=omega)},
    )
    expected = lx.simulate(other, begin, t1=1.0, accuracy=lx.PRECISE)
    np.testing.assert_allclose(found.position("top"), expected.position("top"), atol=1e-8)
    np.testing.assert_allclose(found.orientation("top"), expected.orientation("top"), atol=1e-8)
    np.testing.assert_allclose(found.reaction("slot").force, expected.reaction("ball").force, atol=1e-6)


class Mistaken(lx.AbstractJoint):
    speed_units = ("m",)
    mistake: str = eqx.field(static=True)

    def __init__(self, mistake):
        super().__init__("wire", lx.GROUND, lx.point_mass("bead", 1.0), "x")
        self.mistake = mistake

    def transform(self, coordinates):
        match self.mistake:
            case "shape":
                return jnp.eye(3), coordinates
            case "axes":
                return 2.0 * jnp.eye(3), jnp.zeros(3)
            case "name":
                return jnp.eye(3), self.radius * jnp.ones(3)


@pytest.mark.parametrize(
    ("mistake", "told"),
    [
        ("shape", r"joint 'wire': its transform returns shapes \(\(3, 3\), \(1,\)\)"),
        ("axes", "joint 'wire': its transform returns axes .* are not orthonormal"),
        ("name", "joint 'wire': its transform raises AttributeError"),
    ],
)
def test_mistakes_are_named(mistake, told):
    with pytest.raises(ValueError, match=told):
        lx.Mechanism([lx.point_mass("bead", 1.0)], [Mistaken(mistake)])
