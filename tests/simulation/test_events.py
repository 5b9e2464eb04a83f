"""Events, and derivatives that do not exist."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from mechanisms import crank_slider, pendulum

import linkax as lx

FINE = lx.Accuracy(rtol=1e-11)
SAVE_END = diffrax.SaveAt(t1=True)
ROOT = optx.Newton(1e-12, 1e-12)
MODES = [(diffrax.RecursiveCheckpointAdjoint(), jax.jacrev), (diffrax.ForwardMode(), jax.jacfwd)]
in_both_modes = pytest.mark.parametrize(("adjoint", "derivative"), MODES, ids=["backwards", "forwards"])


def rotor(torque, **options):
    """A rotor of inertia one, at rest, driven by a constant torque."""
    disc = lx.RigidBody("disc", 1.0, [0.0, 0.0, 0.0], jnp.ones(3))
    hinge = lx.Revolute("hinge", lx.GROUND, disc, axis="z")
    mechanism = lx.Mechanism([disc], [hinge], [lx.JointTorque("hinge", torque)])
    start = lx.State(jnp.zeros(1), jnp.zeros(1))
    return lx.simulate(mechanism, start, **{"accuracy": FINE, "saveat": SAVE_END} | options)


def driven(length, **options):
    """A crank-slider whose crank of one metre turns by one radian a second."""
    mechanism = crank_slider(rod=length, constraints=[lx.Drive("motor", "bearing", lambda t: 0.5 + t)])
    return lx.simulate(mechanism, lx.assemble(mechanism), accuracy=FINE, saveat=SAVE_END, **options)


def turned(t, state, mechanism):
    return state.q[0] - 2.0


def twice(found):
    """To differentiate, and as it is: one program for both."""
    return found, found


@pytest.mark.parametrize(
    ("adjoint", "derivative"),
    [pytest.param(*MODES[0], marks=pytest.mark.slow), MODES[1]],
    ids=["backwards", "forwards"],
)
def test_root_of_an_event_against_the_closed_form(adjoint, derivative):
    """½ T t² = 2: t = 2 / √T, and the speed there is 2 √T."""

    def end(torque):
        found = rotor(torque, t1=5.0, event=diffrax.Event(turned, ROOT), adjoint=adjoint)
        return twice(jnp.stack([found.t_end, found.end.q[0], found.end.v[0]]))

    slopes, values = jax.jit(derivative(end, has_aux=True))(1.5)
    np.testing.assert_allclose(values, [2.0 / np.sqrt(1.5), 2.0, 2.0 * np.sqrt(1.5)], atol=1e-9)
    np.testing.assert_allclose(slopes, [-(1.5**-1.5), 0.0, 1.5**-0.5], atol=1e-8)


FIXED = {"dt0": 0.1, "stepsize_controller": diffrax.ConstantStepSize()}


@pytest.mark.parametrize("steps", [{}, FIXED], ids=["adaptive", "fixed"])
@pytest.mark.parametrize(
    ("direction", "angle"), [pytest.param(False, 0.5 * np.pi, marks=pytest.mark.slow), (True, 1.5 * np.pi)]
)
def test_direction_of_an_event(direction, angle, steps):
    """The cosine of an angle ½ T t² falls through zero at π/2, and rises through it at 3π/2."""

    def cosine(t, state, mechanism):
        return jnp.cos(lx.Solution.of_state(mechanism, state, t=t).joint("hinge")[0])

    found = rotor(1.5, t1=5.0, event=diffrax.Event(cosine, ROOT, direction), **steps)
    np.testing.assert_allclose(found.t_end, np.sqrt(2.0 * angle / 1.5), atol=1e-9)


def test_the_first_of_several_conditions_ends_the_run():
    """Of those that one step passes, whatever their order."""

    def end(angles):
        reaches = lambda angle: lambda t, state, mechanism: state.q[0] - angle
        return rotor(2.0, t1=5.0, event=diffrax.Event([reaches(angle) for angle in angles], ROOT)).t_end

    angles = np.random.default_rng(0).uniform(0.1, 20.0, (50, 3))
    np.testing.assert_allclose(jax.jit(jax.vmap(end))(angles), np.sqrt(np.min(angles, axis=1)), rtol=1e-9)


def bouncing(height, condition, adjoint=None, **options):
    """A ball that falls from a height onto a table, and comes up again with 0.8 of its speed."""
    ball = lx.point_mass("ball", 1.0)
    slide = lx.Prismatic("slide", lx.GROUND, ball, axis="y")
    forces = [lx.Gravity([0.0, -9.81, 0.0]), lx.Impact("slide", lower=0.0, restitution=0.8)]
    mechanism = lx.Mechanism([ball], [slide], forces)
    start = lx.State(jnp.reshape(height, 1), jnp.zeros(1))
    event = diffrax.Event(condition, **options)
    return lx.simulate(mechanism, start, t1=3.0, saveat=SAVE_END, event=event, adjoint=adjoint, throw=False)


@pytest.mark.parametrize("seen", ["rises", "turns", "touches"])
def test_an_event_between_impacts_is_seen(seen):
    """A flight is one step, and a condition is often at its end what it was at its begin."""
    at_half = lambda t, state, mechanism: state.q[0] - 0.5
    upwards = lambda t, state, mechanism: state.v[0]
    height = lambda t, state, mechanism: state.q[0]
    condition, direction = {"rises": (at_half, True), "turns": (upwards, False), "touches": (height, False)}[seen]

    def end(begin):
        found = bouncing(begin, condition, root_finder=ROOT, direction=direction)
        return jnp.stack([found.t_end, jnp.where(found.result == lx.RESULTS.event_occurred, found.end.q[0], jnp.nan)])

    def exact(begin):
        falls = jnp.sqrt(2.0 * begin / 9.81)
        speed = 0.8 * 9.81 * falls
        top = speed / 9.81
        after = {"rises": top - jnp.sqrt(top**2 - 1.0 / 9.81), "turns": top, "touches": 0.0}[seen]
        return jnp.stack([falls + after, {"rises": 0.5, "turns": 0.64 * begin, "touches": 0.0}[seen]])

    begins = np.linspace(0.9, 2.0, 100)
    np.testing.assert_allclose(jax.jit(jax.vmap(end))(begins), jax.vmap(exact)(begins), atol=1e-9)


@pytest.mark.slow
@in_both_modes
def test_derivative_of_an_event_after_an_impact(adjoint, derivative):
    """The time at which the ball is at half a metre again: the flight up begins later, and faster."""
    at_half = lambda t, state, mechanism: state.q[0] - 0.5

    def time(begin):
        return bouncing(begin, at_half, root_finder=ROOT, direction=True, adjoint=adjoint).t_end

    def exact(begin):
        top = 0.8 * jnp.sqrt(2.0 * begin / 9.81)
        return 1.8 / 0.8 * top - jnp.sqrt(top**2 - 1.0 / 9.81)

    np.testing.assert_allclose(jax.jit(derivative(time))(1.2), jax.grad(exact)(1.2), rtol=1e-8)


def test_a_condition_that_jumps_has_no_root():
    """The speed changes its sign at an impact, and is zero nowhere: a run that seeks no root ends there."""
    upwards = lambda t, state, mechanism: state.v[0]
    without = bouncing(1.0, upwards, root_finder=ROOT, direction=True)
    assert without.result == lx.RESULTS.event_without_root
    found = bouncing(1.0, upwards, direction=True)
    np.testing.assert_allclose(found.t_end, np.sqrt(2.0 / 9.81), rtol=1e-9)
    np.testing.assert_allclose(found.end.v, 0.8 * np.sqrt(2.0 * 9.81), rtol=1e-9)


def test_a_condition_that_is_zero_all_along_holds_up_no_run():
    """Its sign is rounding: the run ends at once, or goes on to its end."""
    lies = lambda t, state, mechanism: state.q[0] - 0.5 * t**2
    found = rotor(1.0, t1=5.0, event=diffrax.Event(lies, direction=True), throw=False)
    assert found.stats["num_steps"] < 200


@pytest.mark.slow
@in_both_modes
def test_root_of_an_event_in_a_loop(adjoint, derivative):
    """The slider of a driven crank reaches cos(a) + √(l² − sin²(a)) = 1.6, a = 0.5 + t."""

    def end(length):
        reaches = lambda t, state, mechanism: lx.Solution.of_state(mechanism, state, t=t).position("slider")[0, 0] - 1.6
        return twice(driven(length, t1=3.0, event=diffrax.Event(reaches, ROOT), adjoint=adjoint).t_end)

    def exact(length):
        cosine = (1.6**2 + 1.0 - length**2) / (2.0 * 1.6)
        return jnp.arccos(cosine) - 0.5

    slope, value = jax.jit(derivative(end, has_aux=True))(1.8)
    np.testing.assert_allclose(value, exact(1.8), atol=1e-9)
    np.testing.assert_allclose(slope, derivative(exact)(1.8), atol=1e-8)


@pytest.mark.parametrize(("adjoint", "derivative"), [pytest.param(*MODES[0], marks=pytest.mark.slow), MODES[1]])
def test_end_of_a_step_has_no_derivative(adjoint, derivative):
    """Without a root finder a run ends with a step, which follows no number: saved times before it do."""

    def motion(torque):
        saveat = diffrax.SaveAt(ts=[0.5], t1=True)
        found = rotor(torque, t1=5.0, event=diffrax.Event(turned), adjoint=adjoint, saveat=saveat)
        return jnp.stack([found.q[0, 0], found.q[1, 0], found.t_end, found.end.q[0]])

    slopes = jax.jit(derivative(motion))(1.5)
    np.testing.assert_allclose(slopes, [0.125, np.nan, np.nan, np.nan], atol=1e-8)


ADJOINTS = [(None, jax.jacrev), *(pytest.param(*mode, marks=pytest.mark.slow) for mode in [(None, jax.jacfwd), *MODES])]


@pytest.mark.parametrize(("adjoint", "derivative"), ADJOINTS)
def test_failed_run_has_no_derivative(adjoint, derivative):
    """It is NaN, not zero; and a member that a loss leaves out spoils the derivative of no other."""

    def end(length, gravity):
        start = lx.State(jnp.array([0.3]), jnp.zeros(1))
        options = {"t1": 2.0, "max_steps": 40, "adjoint": adjoint, "saveat": SAVE_END}
        found = lx.simulate(pendulum(length, gravity=gravity), start, **options)
        return found.end.q[0], found.result == lx.RESULTS.successful

    def ends(gravity):
        angles, went_well = jax.vmap(end, in_axes=(0, None))(lengths, gravity)
        return (angles, jnp.sum(jnp.where(went_well, angles, 0.0))), went_well

    lengths = jnp.array([0.02, 1.0, 2.0])  # the shortest takes more steps
    (slopes, of_sum), went_well = jax.jit(derivative(ends, has_aux=True))(9.81)
    np.testing.assert_array_equal(went_well, [False, True, True])
    np.testing.assert_array_equal(np.isfinite(slopes), went_well)
    np.testing.assert_allclose(of_sum, np.sum(slopes[1:]), rtol=1e-12)
