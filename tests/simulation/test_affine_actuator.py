"""Affine actuators against closed forms and against MuJoCo; their limits."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx
from linkax.equations.configuration import configure
from linkax.equations.motion import move
from linkax.equations.system import system_of

MASS, TARGET, T1 = 2.0, 1.0, 1.0
SERVO = jnp.array([200.0, 6.0, 5.0])  # gains of position and speed, limit of the force


def servo(numbers, saveat):
    """A weight on a slide, moved from zero to its target by a servo that at first is at its upper limit."""
    stiffness, damping, limit = numbers
    weight = lx.point_mass("weight", MASS)
    actuator = lx.AffineActuator(
        "slide",
        TARGET,
        gain=stiffness,
        bias=[0.0, -stiffness, -damping],
        force_range=[-20.0 * limit, limit],
        name="servo",
    )
    mechanism = lx.Mechanism([weight], [lx.Prismatic("slide", lx.GROUND, weight, "x")], [actuator])
    return lx.simulate(mechanism, lx.State.as_drawn(mechanism), t1=T1, accuracy=lx.Accuracy(rtol=3e-7), saveat=saveat)


def servo_exact(numbers, ts):
    """Coordinate, speed and force in closed form: at the limit up to a time, then a damped swing about the target."""
    stiffness, damping, limit = numbers
    pull = limit / MASS
    half, rest = damping / stiffness * pull, 2.0 * pull * (TARGET - limit / stiffness)
    leaves = (jnp.sqrt(half**2 + rest) - half) / pull
    x, v = pull * leaves**2 / 2.0 - TARGET, pull * leaves
    decay = damping / (2.0 * MASS)
    rate = jnp.sqrt(stiffness / MASS - decay**2)
    since = jnp.maximum(ts - leaves, 0.0)
    fade, cos, sin = jnp.exp(-decay * since), jnp.cos(rate * since), jnp.sin(rate * since)
    swing = fade * (x * cos + (v + decay * x) / rate * sin)
    speed = fade * (v * cos - (decay * v + stiffness / MASS * x) / rate * sin)
    force = -stiffness * swing - damping * speed
    early = ts < leaves
    each = ((pull * ts**2 / 2.0, TARGET + swing), (pull * ts, speed), (jnp.full_like(ts, limit), force))
    return jnp.stack([jnp.where(early, *pair) for pair in each])


def test_a_servo_at_its_limit_and_below():
    """Coordinate, speed and force; its work is the kinetic energy, which has no other cause."""
    ts = np.linspace(0.0, T1, 501)
    found, (x, v, force) = servo(SERVO, diffrax.SaveAt(ts=ts)), jax.jit(servo_exact)(SERVO, ts)
    assert np.min(force) < -5.0 * SERVO[2]
    np.testing.assert_allclose(found.q[:, 0], x, atol=1e-6)
    np.testing.assert_allclose(found.v[:, 0], v, atol=1e-5)
    np.testing.assert_allclose(found.force("servo"), force, atol=1e-3)
    np.testing.assert_allclose(found.work()["servo"], MASS * v**2 / 2.0, atol=1e-4)


@pytest.mark.slow
def test_derivatives_of_a_servo_that_leaves_its_limit():
    def end(numbers):
        found = servo(numbers, diffrax.SaveAt(t1=True)).end
        return jnp.concatenate([found.q, found.v])

    @jax.jit
    def both(numbers):
        value, forwards = jax.linearize(end, numbers)
        backwards = jax.vmap(lambda weights: jax.linear_transpose(forwards, numbers)(weights)[0])(jnp.eye(2))
        exact = lambda numbers: servo_exact(numbers, jnp.array(T1))[:2]
        return value, jax.vmap(forwards, out_axes=1)(jnp.eye(3)), backwards, exact(numbers), jax.jacfwd(exact)(numbers)

    value, forwards, backwards, exact, slopes = both(SERVO)
    np.testing.assert_allclose(value, exact, rtol=1e-6)
    np.testing.assert_allclose(forwards, slopes, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(backwards, forwards, rtol=1e-9, atol=1e-12)


MJCF = """
<mujoco>
  <worldbody><body name="arm">
    <joint name="hinge" axis="0 0 1"/><geom type="sphere" size="0.1" mass="1"/>
    <body name="cart" pos="0.5 0 0">
      <joint name="slide" type="slide" axis="1 0 0"/><geom type="sphere" size="0.1" mass="1"/>
      <body name="tool"><joint name="wrist" axis="0 1 0"/><geom type="sphere" size="0.1" mass="1" pos="0 0 0.2"/></body>
    </body>
  </body></worldbody>
  <tendon><fixed name="tendon"><joint joint="hinge" coef="0.7"/><joint joint="slide" coef="-1.9"/></fixed></tendon>
  <actuator>
    <general tendon="tendon" gaintype="affine" gainprm="1.3 0.4 -0.6" biastype="affine" biasprm="0.9 -5.0 -2.0"/>
    <general joint="wrist" gear="3" gainprm="2" biastype="affine" biasprm="-0.2 -4 -1" forcerange="-7 4"/>
  </actuator>
</mujoco>
"""


def moved(mechanism):
    """A function from coordinates and speeds to the motion of a mechanism."""
    system = system_of(mechanism, float)
    return lambda q, v: move(configure(system, 0.0, q), v)


def test_generalised_forces_are_those_of_mujoco():
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(MJCF)
    data = mujoco.MjData(model)
    arm, cart, tool = (lx.RigidBody(name, 1.0, inertia=[0.1, 0.1, 0.1]) for name in ("arm", "cart", "tool"))
    joints = [
        lx.Revolute("hinge", lx.GROUND, arm, "z"),
        lx.Prismatic("slide", arm.at([0.5, 0.0, 0.0]), cart, "x"),
        lx.Revolute("wrist", cart, tool, "y"),
    ]
    motion = moved(lx.Mechanism([arm, cart, tool], joints))

    @jax.jit
    @jax.vmap
    def forces(q, v, controls):
        actuators = [
            lx.AffineActuator(
                {"hinge": 0.7, "slide": -1.9}, controls[0], gain=[1.3, 0.4, -0.6], bias=[0.9, -5.0, -2.0]
            ),
            lx.AffineActuator({"wrist": 3.0}, controls[1], gain=2.0, bias=[-0.2, -4.0, -1.0], force_range=[-7.0, 4.0]),
        ]
        return jnp.stack([actuator.applied(0.0, motion(q, v)).joint_force for actuator in actuators])

    q, v, controls = np.random.default_rng(0).normal(size=(3, 40, 3))
    expected = []
    for at in zip(q, v, controls[:, :2], strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = at
        mujoco.mj_forward(model, data)
        expected.append(data.qfrc_actuator.copy())
    found = np.asarray(forces(q, v, controls[:, :2]))
    np.testing.assert_allclose(np.sum(found, axis=1), expected, rtol=1e-12, atol=1e-12)
    assert {-7.0, 4.0} < set(np.round(found[:, 1, 2] / 3.0, 12).tolist())


def test_a_spring_with_a_damper_at_a_cut_joint():
    """The same load as that of the elements for one joint, whose angle counts turns."""
    bars = [lx.rod("crank", 0.3, 1.0), lx.rod("rocker", 0.5, 1.0)]
    joints = [
        lx.Revolute("base", lx.GROUND, bars[0].at("base"), "z"),
        lx.Revolute("far", lx.GROUND.at([0.6, 0.0, 0.0]), bars[1].at("base"), "z"),
        lx.Revolute("pin", bars[0].at("tip"), bars[1].at("tip"), "z", cut=True),
    ]
    elements = lx.AffineActuator("pin", gain=0.0, bias=[0.0, -40.0, -3.0]), lx.JointSpring("pin", 40.0)
    elements = *elements, lx.JointDamper("pin", 3.0)
    motion = moved(lx.Mechanism(bars, joints, elements))

    @jax.jit
    @jax.vmap
    def loads(q, v):
        actuator, spring, damper = (element.applied(0.0, motion(q, v)) for element in elements)
        return actuator, spring.plus(damper)

    found, expected = loads(
        jnp.array([[0.3, 1.0, 0.2], [2.9, -0.8, 3.9]]), jnp.array([[1.0, -2.0, 0.7], [0.5, 0.1, -1.0]])
    )
    assert np.max(np.abs(expected.joint_force)) > 10.0
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-13)
