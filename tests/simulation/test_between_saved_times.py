"""Motion between its saved times: as accurate as its polynomial, with the derivatives that it should have."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import crank_slider, pendulum

import linkax as lx

EVERY = (8, 4)  # of the saved states: what is left of them


def thinned(solution, every):
    parts = {name: getattr(solution, name)[::every] for name in ("ts", "q", "v")}
    return dataclasses.replace(solution, **parts)


@pytest.fixture(scope="module")
def loop():
    """A loop with a cut joint."""
    mechanism = crank_slider(cut="wrist_pin")
    state = lx.assemble(mechanism, {"bearing": 0.4}, {"bearing": 3.0})
    saveat = diffrax.SaveAt(ts=np.linspace(0.0, 1.0, 241))
    return lx.simulate(mechanism, state, t1=1.0, accuracy=lx.Accuracy(1e-11), saveat=saveat)


@pytest.fixture(scope="module")
def rod():
    return swing(0.4, accuracy=lx.Accuracy(1e-11))


@pytest.fixture(scope="module")
def top():
    """A body that turns about all axes, by a quaternion."""
    body = lx.RigidBody("top", 1.0, [0.0, 0.0, 0.3], inertia=[0.1, 0.12, 0.05])
    mechanism = lx.Mechanism([body], [lx.Spherical("ball", lx.GROUND, body)], [lx.Gravity([0.0, 0.0, -9.81])])
    state = lx.State(jnp.eye(4)[0], jnp.array([2.0, 1.0, 5.0]))
    saveat = diffrax.SaveAt(ts=np.linspace(0.0, 1.0, 241))
    return lx.simulate(mechanism, state, t1=1.0, accuracy=lx.Accuracy(1e-11), saveat=saveat)


@pytest.mark.parametrize("name", [pytest.param("loop", marks=pytest.mark.slow), "top"])
def test_order(name, request):
    """Six of coordinates, five of speeds, and quaternions stay such."""
    solution = request.getfixturevalue(name)
    found = [thinned(solution, every).at(solution.ts) for every in EVERY]
    for part, order in (("q", 6), ("v", 5)):
        exact = getattr(solution, part)
        coarse, fine = (float(np.max(np.abs(getattr(motion, part) - exact))) for motion in found)
        assert 0.0 < fine < 1e-4 * np.max(np.abs(exact))
        assert abs(np.log2(coarse / fine) - order) < 0.8
    if name == "top":
        np.testing.assert_allclose(np.linalg.norm(found[0].q, axis=1), 1.0, rtol=1e-14)
        return
    for read in (lambda s: s.joint("wrist_pin"), lambda s: s.reaction("wrist_pin").force):
        exact, fine = read(solution), read(found[1])
        np.testing.assert_allclose(fine, exact, atol=2e-4 * np.max(np.abs(exact)))


def test_at_saved_times_nothing_changes(top):
    solution = thinned(top, 12)
    back = solution.at(solution.ts[::-1])
    np.testing.assert_allclose(back.q, solution.q[::-1], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(back.v, solution.v[::-1], rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "joint"), [pytest.param("loop", "wrist_pin", marks=pytest.mark.slow), ("rod", "hinge")]
)
def test_derivatives_by_time_are_speeds(name, joint, request):
    solution, ts = request.getfixturevalue(name), jnp.array([0.123, 0.5, 0.789])

    @jax.jit
    def read(ts):
        turned = lambda t: solution.at(t).joint(joint)
        _, along = jax.jvp(turned, (ts,), (jnp.ones(3),))
        return along, solution.at(ts).joint_speed(joint), jax.grad(lambda t: jnp.sum(turned(t)))(ts)

    along, speeds, backwards = read(ts)
    np.testing.assert_allclose(along, speeds, rtol=1e-7)
    np.testing.assert_allclose(backwards, along, rtol=1e-9)


def swing(angle, steps=4096, **options):
    state, saveat = lx.State(jnp.reshape(angle, 1), jnp.zeros(1)), diffrax.SaveAt(ts=jnp.linspace(0.0, 1.0, 41))
    return lx.simulate(pendulum(), state, t1=1.0, saveat=saveat, max_steps=steps, throw=False, **options)


def test_batches_and_times_of_their_own():
    solution = jax.vmap(swing)(jnp.array([-0.5, 0.7]))
    shared = solution.at([0.11, 0.52, 0.52]).joint("hinge")
    own = solution.at(jnp.array([[0.11, 0.52], [0.52, 0.11]])).joint("hinge")
    np.testing.assert_allclose(shared[:, :2], np.stack([own[0], own[1, ::-1]]), rtol=1e-12)
    # Times that are traced, and outside: infinite, and harmless to the derivatives of others.
    total = lambda ts: jnp.sum(jnp.where(jnp.array([True, False, False]), solution.at(ts).joint("hinge")[0], 0.0))
    slope = jax.jit(jax.grad(total))(jnp.array([0.5, 1.5, -0.1]))
    np.testing.assert_allclose(slope[0], solution.at([0.5]).joint_speed("hinge")[0, 0], rtol=1e-6)
    np.testing.assert_array_equal(slope[1:], 0.0)
    late = jax.jit(lambda ts: solution.at(ts).ts)(jnp.array([0.5, 1.5]))
    np.testing.assert_array_equal(np.isinf(late), [[False, True]] * 2)
    short = swing(-0.5, 8)
    reached = np.flatnonzero(np.isfinite(short.ts))[-1]
    assert 0 < reached < 40
    np.testing.assert_allclose(short.at(short.ts[: reached + 1]).q, short.q[: reached + 1], rtol=1e-12)
    with pytest.raises(ValueError, match="time 1 s is outside of the saved motion, from 0 s to"):
        short.at([1.0])


def test_bad_times_are_named(top):
    solution = top
    with pytest.raises(ValueError, match=r"time 1\.2 s is outside of the saved motion, from 0 s to 1 s; simulate lon"):
        solution.at([0.1, 1.2])
    with pytest.raises(ValueError, match="must be finite"):
        solution.at([0.1, np.nan])
    with pytest.raises(ValueError, match=r"times \[s\] have shape \(1, 1\); give \(n,\) times"):
        solution.at([[0.5]])
    with pytest.raises(ValueError, match=r"times \[s\] have shape \(0,\), .* give at least one"):
        solution.at([])
    np.testing.assert_array_equal(solution.at(0.5).q, solution.at([0.5]).q)
    alone = lx.Solution.of_state(solution.mechanism, solution.end)
    with pytest.raises(ValueError, match="has one time, and no motion between"):
        alone.at([0.0])
