"""Points on surfaces, prescribed poses, gears and racks on axes that move: against closed forms."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import linkax as lx

GRAVITY = lx.Gravity([0.0, 0.0, -9.81])
TS = np.linspace(0.0, 1.0, 21)


def run(mechanism, state, **options):
    return lx.simulate(
        mechanism, state, t1=1.0, accuracy=lx.PRECISE, saveat=diffrax.SaveAt(ts=jnp.asarray(TS)), **options
    )


def conical(radius):
    """A ball that circles in a bowl at 0.6 of its radius, at the speed that keeps it there."""
    ball = lx.RigidBody("ball", 0.5, inertia=[1e-3, 1e-3, 1e-3])
    surface = lambda x: jnp.sqrt(jnp.sum(x**2)) - radius
    bowl = lx.PointOnSurface("bowl", ball, lx.GROUND.at([0.0, 0.0, 2.0]), surface)
    mechanism = lx.Mechanism([ball], [lx.Free("flight", lx.GROUND, ball)], [GRAVITY], [bowl])
    speed = jnp.sqrt(9.81 / (0.8 * radius))  # ω² = g / (r cos)
    place = jnp.array([0.6 * radius, 0.0, 2.0 - 0.8 * radius])
    q, v = jnp.concatenate([jnp.eye(4)[0], place]), jnp.zeros(6).at[4].set(0.6 * radius * speed)
    return mechanism, lx.State(q, v, mechanism.topology), speed


@pytest.mark.slow
def test_a_ball_in_a_bowl_circles():
    mechanism, state, speed = conical(jnp.array(0.5))
    found = run(mechanism, state)
    place = found.position("ball")
    np.testing.assert_allclose(place[:, 0], 0.3 * np.cos(speed * TS), atol=1e-9)
    np.testing.assert_allclose(place[:, 2], 1.6, atol=1e-10)
    np.testing.assert_allclose(found.reaction("bowl"), -0.5 * 9.81 / 0.8, rtol=1e-9)  # towards the centre


def shaken(height):
    """A table that is lifted, and turns about z with its axis askew; where it is after 0.4 s, and its reaction."""
    table = lx.RigidBody("table", 2.0, [0.1, 0.0, 0.0], [0.1, 0.2, 0.3])
    lift = lambda t: jnp.stack([0.0 * t, 0.0 * t, height * t**2])

    def turned(t):
        c, s = jnp.cos(t**2), jnp.sin(t**2)
        zero, one = jnp.zeros_like(c), jnp.ones_like(c)
        return jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)

    shaker = lx.Prescribed("shaker", table, lift, turned)
    mechanism = lx.Mechanism([table], [lx.Free("flight", lx.GROUND, table)], [GRAVITY], [shaker])
    return lx.simulate(mechanism, lx.assemble(mechanism), t1=1.0, saveat=diffrax.SaveAt(ts=jnp.asarray(TS)))


@pytest.mark.slow
def test_a_prescribed_pose():
    """Force m (a − g) of the centre of mass, moment about the point; and the work of the shaker is the energy."""
    found = shaken(jnp.array(0.3))
    force, moment = np.split(np.asarray(found.reaction("shaker")), 2, axis=-1)
    rate, spin = 2.0 * TS, 2.0
    out = np.stack([np.cos(TS**2), np.sin(TS**2), 0.0 * TS], axis=-1)
    across = np.stack([-out[:, 1], out[:, 0], 0.0 * TS], axis=-1)
    acceleration = 0.1 * (spin * across - rate[:, None] ** 2 * out) + np.array([0.0, 0.0, 0.6 + 9.81])
    np.testing.assert_allclose(force, 2.0 * acceleration, atol=1e-7)
    about = np.cross(0.1 * out, 2.0 * acceleration) + np.array([0.0, 0.0, 0.3 * spin])
    np.testing.assert_allclose(moment, about, atol=1e-7)
    np.testing.assert_allclose(found.unaccounted_energy(), 0.0, atol=1e-7)
    assert np.max(np.abs(found.position("table")[:, 2] - 0.3 * TS**2)) < 1e-12


def test_planetary_gears():
    """Willis: a planet of 20 teeth turns by (1 ± z₁ / z₂) of its carrier, around a sun of 40 or inside a ring of 80."""
    bodies, joints, gears, speeds = [], [], [], {}
    ratios = {"sun": 1.0 + 40 / 20, "ring": 1.0 - 80 / 20}
    for name, ratio in ratios.items():
        carrier = lx.rod(f"{name}_carrier", 0.06, 1.0)
        planet = lx.RigidBody(f"{name}_planet", 0.5, inertia=[1e-4, 1e-4, 2e-4])
        bodies += [carrier, planet]
        joints += [
            lx.Revolute(f"{name}_axle", lx.GROUND, carrier.at("base"), "z"),
            lx.Revolute(f"{name}_pin", carrier.at("tip"), planet, "z"),
        ]
        teeth = 80 if name == "ring" else 40
        gears.append(lx.Gear(name, lx.GROUND, planet, (teeth, 20), internal=name == "ring"))
        speeds |= {f"{name}_axle": 9.0, f"{name}_pin": 9.0 * (ratio - 1.0)}
    mechanism = lx.Mechanism(bodies, joints, [lx.JointTorque(f"{name}_axle", 0.2) for name in ratios], gears)
    state = lx.State(jnp.zeros(4), jnp.array([speeds[joint] for joint in mechanism.topology.speeds]))
    assert lx.mobility(mechanism, state).degrees_of_freedom == 2
    q = dict(zip(mechanism.topology.coordinates, np.asarray(run(mechanism, state).q).T, strict=True))
    for name, ratio in ratios.items():
        carrier = q[f"{name}_axle"]
        turned = carrier + q[f"{name}_pin"]
        np.testing.assert_allclose(turned - turned[0], ratio * carrier, atol=1e-10)
        inertia = 0.06**2 / 3.0 + 0.5 * 0.06**2 + 2e-4 * ratio**2
        np.testing.assert_allclose(carrier, 9.0 * TS + 0.1 / inertia * TS**2, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_a_rack_on_a_slide():
    """A pinion on a slope of the rack: s̈ = g sin α · m / (m + I / r²), over many teeth; the reaction is I s̈ / r²."""
    rack, pinion = lx.RigidBody("rack", 1.0), lx.RigidBody("pinion", 2.0, inertia=[1e-3, 1e-3, 2e-3])
    slope = lx.GROUND.at([0.0, 0.0, 0.0], [[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    joints = [lx.Fixed("floor", slope, rack), lx.Planar("plane", rack.at([0.0, 0.05, 0.0]), pinion, "z")]
    level = lx.Coupling("level", {("plane", 2): 1.0})
    mesh = lx.Rack("mesh", pinion, rack, 25, 0.004)
    mechanism = lx.Mechanism([rack, pinion], joints, [lx.Gravity([0.0, -9.81, 0.0])], [level, mesh])
    found = run(mechanism, lx.assemble(mechanism, {("plane", 1): 0.0}))
    acceleration = 9.81 * 0.6 * 2.0 / (2.0 + 2e-3 / 0.05**2)
    np.testing.assert_allclose(found.joint("plane")[:, 1], acceleration * TS**2 / 2.0, atol=1e-9)
    np.testing.assert_allclose(found.reaction("mesh"), -2e-3 / 0.05**2 * acceleration, rtol=1e-8)


def circled(radius):
    mechanism, state, _ = conical(radius)
    return run(mechanism, state).q[-1, 4]


def lifted(height):
    return shaken(height).reaction("shaker")[4, 2]


@pytest.mark.slow
@pytest.mark.parametrize("function", [circled, lifted])
def test_derivatives(function):
    at, step = 0.5, 1e-5
    backwards, forwards = jax.grad(function)(at), jax.jacfwd(function)(at)
    central = (function(jnp.array(at + step)) - function(jnp.array(at - step))) / (2.0 * step)
    np.testing.assert_allclose([backwards, forwards], central, rtol=1e-6)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda body: lx.PointOnSurface("bowl", body, lx.GROUND, lambda x: x), "surface 'bowl': function"),
        (lambda body: lx.Prescribed("lift", body, lambda t: t), r"prescribed pose 'lift': position \[m\]"),
        (lambda body: lx.Gear("mesh", lx.GROUND, body, (20, 1.5)), "gear 'mesh': teeth is 1.5"),
        (lambda body: lx.Gear("mesh", lx.GROUND, body, 20), "gear 'mesh': teeth are 20"),
        (lambda body: lx.Rack("mesh", lx.GROUND, body, 20, 0.0), r"rack 'mesh': module \[m\] is 0.0"),
    ],
)
def test_mistakes(make, told):
    with pytest.raises(ValueError, match=told):
        make(lx.point_mass("ball", 1.0))
