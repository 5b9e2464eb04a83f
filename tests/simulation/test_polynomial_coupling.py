"""Couplings of joints by polynomials against closed forms and against MuJoCo."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx
from linkax.equations.configuration import configure
from linkax.equations.constraint_rows import constraint_jacobian, constraint_residual
from linkax.equations.system import system_of

COEFFICIENTS = jnp.array([0.2, -0.5, 0.7, 0.3])
POWERS = np.arange(4)
START = 0.6, -1.5  # coordinate and speed of x
LENGTH, MASS, G = 0.8, 1.5, 9.81


def coupled(coefficients):
    """Two pendulums; the angle of one is a polynomial of the other's."""
    rods = lx.rod("first", 1.0, 1.0), lx.rod("second", LENGTH, MASS)
    hinges = [lx.Revolute(name, lx.GROUND, rod.at("base"), "z") for name, rod in zip(("x", "y"), rods, strict=True)]
    coupling = lx.PolynomialCoupling("coupling", "y", "x", coefficients)
    return lx.Mechanism(rods, hinges, [lx.Gravity([0.0, -G, 0.0])], [coupling])


def closed(coefficients, x, speed):
    mechanism = coupled(coefficients)
    return mechanism, lx.assemble(mechanism, {"x": x}, {"x": speed})


def value(x):
    return x[..., None] ** POWERS @ np.asarray(COEFFICIENTS)


def slope(x):
    return POWERS[1:] * x[..., None] ** POWERS[:-1] @ np.asarray(COEFFICIENTS)[1:]


def test_two_hinges():
    """The coordinate and the speed of one by those of the other, the energy, and Euler's equation of one with μ."""
    mechanism, (x, speed) = coupled(COEFFICIENTS), np.array(START)
    start = {"x": (x, speed), "y": (value(x), slope(x) * speed)}
    state = lx.State(*np.transpose([start[name] for name in mechanism.topology.coordinates]))
    assert lx.mobility(mechanism, state).degrees_of_freedom == 1
    found = lx.simulate(mechanism, state, t1=2.0, accuracy=lx.PRECISE)
    of = mechanism.topology.coordinates
    (x, speed), (y, rate) = ((found.q[:, of[name]][:, 0], found.v[:, of[name]][:, 0]) for name in "xy")
    assert np.ptp(x) > 1.0
    np.testing.assert_allclose(y, value(x), atol=1e-12)
    np.testing.assert_allclose(rate, slope(x) * speed, atol=1e-11)
    np.testing.assert_allclose(found.energy(), found.energy()[0], atol=1e-9)
    torque = MASS * LENGTH**2 / 3.0 * found.joint_acceleration("y") + MASS * G * LENGTH / 2.0 * np.cos(y)
    np.testing.assert_allclose(found.reaction("coupling"), torque, atol=1e-9)


@pytest.mark.slow
def test_derivatives_by_coefficients():
    """Of an assembled coordinate and of its speed: xᵏ, and its rate."""

    def assembled(coefficients):
        _, state = closed(coefficients, *START)
        return jnp.concatenate([state.q, state.v])

    expected = np.zeros((4, 4))
    x, speed = START
    expected[1], expected[3, 1:] = x**POWERS, speed * POWERS[1:] * x ** POWERS[:-1]
    for found in (jax.jacfwd(assembled)(COEFFICIENTS), jax.jacrev(assembled)(COEFFICIENTS)):
        np.testing.assert_allclose(found, expected, atol=1e-10)


MJCF = """
<mujoco>
  <option jacobian="dense"/>
  <worldbody>
    <body><joint name="a" axis="0 0 1"/><geom type="sphere" size="0.1" pos="1 0 0" mass="1"/></body>
    <body pos="3 0 0"><joint name="b" axis="0 0 1"/><geom type="sphere" size="0.1" pos="1 0 0" mass="1"/></body>
    <body pos="6 0 0"><joint name="c" type="slide" axis="1 0 0"/><geom type="sphere" size="0.1" mass="1"/></body>
  </worldbody>
  <tendon>
    <fixed name="one"><joint joint="a" coef="0.7"/><joint joint="c" coef="2"/></fixed>
    <fixed name="other"><joint joint="a" coef="-0.3"/><joint joint="b" coef="1.5"/></fixed>
  </tendon>
  <equality>
    <tendon tendon1="one" tendon2="other" polycoef="0.1 0.8 -0.5 0.2 0.3"/>
    <joint joint1="b" joint2="c" polycoef="0 1.2 0 -0.4 0.6"/>
  </equality>
</mujoco>
"""


def test_rows_are_those_of_mujoco():
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    bodies = [lx.RigidBody(name, 1.0, [1.0, 0.0, 0.0], 0.1) for name in ("first", "second", "third")]
    kinds = lx.Revolute, lx.Revolute, lx.Prismatic
    joints = [
        kind(name, lx.GROUND, body, axis) for kind, name, body, axis in zip(kinds, "abc", bodies, "zzx", strict=True)
    ]
    couplings = [
        lx.PolynomialCoupling("tendons", {"a": 0.7, "c": 2.0}, {"a": -0.3, "b": 1.5}, [0.1, 0.8, -0.5, 0.2, 0.3]),
        lx.PolynomialCoupling("joints", "b", "c", [0.0, 1.2, 0.0, -0.4, 0.6]),
    ]
    mechanism = lx.Mechanism(bodies, joints, constraints=couplings)
    system = system_of(mechanism, float)
    order = [mechanism.topology.column(lx.Term(name, None)) for name in "abc"]

    @jax.jit
    @jax.vmap
    def rows(q):
        at, scales = configure(system, 0.0, q), system.constraint_scales
        return constraint_residual(at) * scales, constraint_jacobian(at)[:, np.array(order)] * scales[:, None]

    places = np.random.default_rng(1).normal(size=(10, 3))
    q = np.zeros_like(places)
    q[:, order] = places
    residuals, slopes = map(np.asarray, rows(q))
    for place, residual, along in zip(places, residuals, slopes, strict=True):
        data.qpos[:] = place
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(np.sort(residual), np.sort(data.efc_pos), rtol=1e-12, atol=1e-12)
        of_mujoco = data.efc_J.reshape(2, 3)[np.argsort(data.efc_pos)]
        np.testing.assert_allclose(along[np.argsort(residual)], of_mujoco, rtol=1e-12, atol=1e-12)
