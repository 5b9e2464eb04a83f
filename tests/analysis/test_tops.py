"""Small motions about the steady motions of a heavy top, on a ball and in gimbals, against closed forms."""

import jax.numpy as jnp
import numpy as np
import pytest
from test_slips import nearest

import linkax as lx

ACROSS, AXIAL, WEIGHT = 0.15, 0.04, 1.2 * 9.81 * 0.3  # moments of inertia about the point that is held; m g l


def top():
    """Its axis is z."""
    across = ACROSS - 1.2 * 0.3**2
    return lx.RigidBody("top", 1.2, [0.0, 0.0, 0.3], inertia=[across, across, AXIAL])


def on_a_ball():
    body = top()
    return lx.Mechanism([body], [lx.Spherical("ball", lx.GROUND, body)], [lx.Gravity([0.0, 0.0, -9.81])])


def in_gimbals(*axes):
    """In two rings without mass."""
    bodies = [lx.RigidBody(name, 0.0, inertia=[0.0, 0.0, 0.0]) for name in ("outer", "inner")] + [top()]
    pairs = zip("abc", [lx.GROUND, *bodies], bodies, axes, strict=False)
    joints = [lx.Revolute(name, parent, child, axis) for name, parent, child, axis in pairs]
    return lx.Mechanism(bodies, joints, [lx.Gravity([0.0, 0.0, -9.81])])


@pytest.mark.slow
def test_a_sleeping_top():
    """A λ² − i C ω λ = m g l of its tilt as a complex number, stable for (C ω)² > 4 A m g l.

    Seen from the body that is λ − i ω.
    """
    critical = np.sqrt(4.0 * ACROSS * WEIGHT) / AXIAL
    ball, gimbals = on_a_ball(), in_gimbals("x", "y", "z")
    for spin in (0.9 * critical, 1.1 * critical):
        tilt = np.roots([ACROSS, -1j * AXIAL * spin, -WEIGHT])
        upright = lx.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, spin]))
        turning = lx.linearise(ball, upright).eigenvalues
        still = lx.linearise(gimbals, lx.State(jnp.zeros(3), upright.v)).eigenvalues
        for found, of_tilt in ((turning, tilt - 1j * spin), (still, tilt)):
            exact = np.array([*of_tilt, *of_tilt.conj(), 0.0, 0.0])
            np.testing.assert_allclose(nearest(found, exact), 0.0, atol=1e-6)
            np.testing.assert_allclose(nearest(exact, found), 0.0, atol=1e-6)
        assert (np.max(still.real) > 1e-3) == (spin < critical)
    single = lx.linearise(ball, lx.State(*(jnp.asarray(part, jnp.float32) for part in (upright.q, upright.v))))
    assert single.stiffness.dtype == jnp.float32
    np.testing.assert_allclose(nearest(single.eigenvalues, turning), 0.0, atol=1e-4)


@pytest.mark.slow
def test_a_top_that_precesses():
    """At Ω with A Ω² cos θ + m g l = C n Ω it nutates at ν² = Ω² − 2 (m g l / A) cos θ + (m g l / (A Ω))².

    Four zeros: two angles go on, and two momenta stay.
    """
    ball, gimbals = on_a_ball(), in_gimbals("z", "x", "z")
    for angle, turning in ((0.6, 3.0), (0.6, 12.0), (np.pi / 2.0, 2.0), (2.0, -2.0)):
        sine, cosine = np.sin(angle), np.cos(angle)
        spin = (ACROSS * turning * cosine + WEIGHT / turning) / AXIAL - turning * cosine
        square = turning**2 - 2.0 * WEIGHT / ACROSS * cosine + (WEIGHT / (ACROSS * turning)) ** 2
        exact = np.array([1j, -1j, 0.0, 0.0]) * np.sqrt(square)
        turned = jnp.array([np.cos(angle / 2.0), np.sin(angle / 2.0), 0.0, 0.0])
        tilted = lx.State(turned, jnp.array([0.0, -spin * sine, turning + spin * cosine]))
        between = lx.State(jnp.array([0.3, angle, 0.2]), jnp.array([turning, 0.0, spin]))
        for found in (lx.linearise(ball, tilted).eigenvalues, lx.linearise(gimbals, between).eigenvalues):
            assert np.sum(np.abs(found) < 1e-4) == 4
            np.testing.assert_allclose(nearest(found, exact)[:2], 0.0, atol=1e-8)
    with pytest.raises(ValueError, match="joint 'ball' accelerates"):
        lx.linearise(ball, lx.State(turned, 1.1 * tilted.v))
