"""Internal states of force elements: integrated, saved, read and differentiated with the motion."""

import dataclasses
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from mechanisms import pendulum

import linkax as lx

VOLTAGE, RESISTANCE, INDUCTANCE, CONSTANT = 12.0, 2.0, 0.1, 0.5
HINGE = lx.Term("hinge", None)
TIMES = np.linspace(0.0, 0.5, 41)


class Motor(lx.AbstractForce):
    """A direct-current motor without friction."""

    resistance: jax.Array | float = RESISTANCE
    current: jax.Array | float = 0.0
    inductance: jax.Array | float = INDUCTANCE
    name: str = eqx.field(static=True, default="motor")

    @property
    def terms(self):
        return (HINGE,)

    @property
    def states(self):
        return {"current": lx.InternalState(self.current, "A")}

    def rates(self, t, motion, states):
        induced = CONSTANT * motion.joint_speed("hinge")
        return {"current": (VOLTAGE - self.resistance * states["current"] - induced) / self.inductance}

    def strength(self, t, motion, states):
        return CONSTANT * states["current"]

    def load(self, t, motion, states):
        return motion.joint_load(HINGE, self.strength(t, motion, states))


def at_rest(angle):
    return lx.State(jnp.full(1, angle), jnp.zeros(1))


def turned(mechanism, t1=0.5, **options):
    times = TIMES[t1 >= TIMES]
    return lx.simulate(mechanism, at_rest(0.3), **{"t1": t1, "saveat": diffrax.SaveAt(ts=times)} | options)


@pytest.fixture(scope="module")
def driven():
    return turned(pendulum(forces=[Motor()]))


def test_the_current_of_a_blocked_motor_rises_as_the_circuit_says():
    held = lx.Drive("hold", "hinge", lambda t: 0.3 + 0.0 * t)
    solution = turned(pendulum(forces=[Motor()], constraints=[held]))
    current = lambda t: VOLTAGE / RESISTANCE * (1.0 - np.exp(-RESISTANCE / INDUCTANCE * t))
    np.testing.assert_allclose(solution.states("motor")["current"], current(TIMES), atol=2e-7)
    np.testing.assert_allclose(solution.force("motor"), CONSTANT * current(TIMES), atol=2e-7)
    between = 0.5 * (TIMES[1:] + TIMES[:-1])
    np.testing.assert_allclose(solution.at(between).states("motor")["current"], current(between), atol=3e-6)
    assert solution.states("motor")["current"][0] == 0.0


def test_energy_put_in_is_accounted_for(driven):
    assert np.max(np.abs(driven.unaccounted_energy())) < 1e-6
    assert abs(driven.work()["motor"][-1]) > 0.1


def test_a_run_goes_on_from_its_end(driven):
    half = turned(driven.mechanism, 0.25)
    rest = lx.simulate(driven.mechanism, half.end, t0=0.25, t1=0.5, saveat=diffrax.SaveAt(ts=TIMES[TIMES >= 0.25]))
    np.testing.assert_allclose(rest.end.internal, driven.end.internal, rtol=1e-7)
    np.testing.assert_allclose(rest.end.q, driven.end.q, rtol=1e-7)


def test_a_solution_of_one_state_knows_them(driven):
    here = lx.Solution.of_state(driven.mechanism, driven.end, t=0.5)
    np.testing.assert_allclose(here.states("motor")["current"], driven.states("motor")["current"][-1:])
    np.testing.assert_allclose(here.joint_acceleration("hinge"), driven.joint_acceleration("hinge")[-1:])
    np.testing.assert_allclose(here.reaction("hinge").force, driven.reaction("hinge").force[-1:])


def _final(parameters):
    solution = turned(pendulum(forces=[Motor(*parameters)]), accuracy=lx.PRECISE)
    return jnp.stack([solution.end.q[0], solution.end.internal[0], solution.states("motor")["current"][17]])


@pytest.mark.slow
def test_derivatives_in_both_modes_by_numbers_and_initial_values():
    parameters = jnp.array([RESISTANCE, 0.7, INDUCTANCE])
    final, changes = jax.jit(_final), np.diag(1e-5 * parameters)
    central = [(final(parameters + h) - final(parameters - h)) / (2.0 * np.sum(h)) for h in changes]
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(_final))(parameters), np.stack(central, axis=1), rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_a_batch_is_read_as_its_members_are(driven):
    currents = jnp.array([0.0, 1.0])
    batch = jax.vmap(lambda current: turned(pendulum(forces=[Motor(current=current)])))(currents)
    found = batch.states("motor")["current"]
    assert found.shape == (2, len(TIMES))
    np.testing.assert_allclose(found[:, 0], currents)
    np.testing.assert_allclose(found[0], driven.states("motor")["current"], atol=1e-7)
    np.testing.assert_allclose(batch.force("motor")[0], driven.force("motor"), atol=1e-7)


class Relaxing(lx.AbstractForce):
    """Two states that fall to zero at a rate, and do nothing."""

    size: float = 1.0
    rate: float = 30.0
    name: str = eqx.field(static=True, default="relaxing")

    @property
    def states(self):
        return {"pair": lx.InternalState(self.size * jnp.array([1.0, 2.0]), "m", scale=self.size)}

    def rates(self, t, motion, states):
        return {"pair": -self.rate * states["pair"]}

    def load(self, t, motion, states):
        return lx.Load.none(motion.system)


@pytest.mark.slow
def test_steps_keep_errors_small_in_the_scale_of_a_state():
    """An array of two states. Next to a pendulum at rest, only their errors choose the steps."""
    errors = []
    for size in (1.0, 1e-6):
        mechanism = pendulum(forces=[Relaxing(size)])
        solution = lx.simulate(mechanism, at_rest(-np.pi / 2), t1=0.5, saveat=diffrax.SaveAt(ts=TIMES))
        exact = size * np.exp(-30.0 * TIMES)[:, None] * [1.0, 2.0]
        errors.append(np.max(np.abs(solution.states("relaxing")["pair"] - exact)) / size)
    assert max(errors) < 5e-7
    np.testing.assert_allclose(*errors, rtol=0.1)


@pytest.mark.slow
def test_a_stiff_state_is_told_with_the_solver_that_suits():
    mechanism = pendulum(forces=[Relaxing(rate=2e4)])
    state = at_rest(0.3)
    with pytest.warns(lx.StiffnessWarning, match="Relaxing 'relaxing', whose fastest rate is 2.0e.04.*Rodas5P"):
        lx.simulate(mechanism, state, t1=0.5)
    solution = lx.simulate(mechanism, state, t1=0.5, solver=lx.Rodas5P())
    assert solution.remark() == lx.REMARKS.none
    assert solution.stats["num_steps"] < 500
    np.testing.assert_allclose(solution.end.internal, 0.0, atol=1e-6)


class Latch(lx.AbstractForce):
    """A torque that is on while a state, which counts time, is above a half of a second's third."""

    @property
    def terms(self):
        return (HINGE,)

    @property
    def states(self):
        return {"clock": lx.InternalState(0.0, "s")}

    def rates(self, t, motion, states, on):
        return {"clock": jnp.ones(())}

    def switch(self, t, motion, states):
        return states["clock"] - 1.0 / 6.0

    def load(self, t, motion, states, on):
        return motion.joint_load(HINGE, jnp.where(on, 5.0, 0.0))


@pytest.mark.slow
def test_a_switch_may_depend_on_a_state():
    latched = turned(pendulum(forces=[Latch()]), accuracy=lx.PRECISE)
    after = lx.JointTorque("hinge", 5.0)
    free, driven = pendulum(), pendulum(forces=[after])
    first = lx.simulate(free, at_rest(0.3), t1=1.0 / 6.0, accuracy=lx.PRECISE)
    second = lx.simulate(driven, first.end, t0=1.0 / 6.0, t1=0.5, accuracy=lx.PRECISE)
    np.testing.assert_allclose(latched.end.q, second.end.q, atol=1e-10)
    np.testing.assert_allclose(latched.end.v, second.end.v, atol=1e-9)


@pytest.mark.slow
def test_single_precision():
    solution = turned(pendulum(forces=[Motor()]), dtype=jnp.float32, accuracy=lx.DRAFT)
    assert solution.internal.dtype == jnp.float32
    assert solution.result == lx.RESULTS.successful


class Learned(lx.AbstractForce):
    """A torque by a network, whose activation is a function among its leaves."""

    network: eqx.nn.MLP

    @property
    def terms(self):
        return (HINGE,)

    def load(self, t, motion):
        seen = jnp.stack([motion.joint("hinge"), motion.joint_speed("hinge")])
        return motion.joint_load(HINGE, self.network(seen))


@pytest.mark.slow
def test_a_network_may_be_a_force():
    network = eqx.nn.MLP(2, "scalar", 4, 1, jnp.tanh, key=jax.random.key(0))
    weights, function = eqx.partition(network, eqx.is_array)
    flat, restored = ravel_pytree(weights)

    def end(flat):
        return turned(pendulum(forces=[Learned(eqx.combine(restored(flat), function))]), accuracy=lx.PRECISE).end.q[0]

    along = jnp.cos(jnp.arange(len(flat)))
    central = (end(flat + 1e-5 * along) - end(flat - 1e-5 * along)) / 2e-5
    np.testing.assert_allclose(jax.grad(end)(flat) @ along, central, rtol=1e-6)


@pytest.mark.slow
def test_a_fit_finds_numbers_and_initial_values():
    measured = turned(pendulum(forces=[Motor(2.3, 0.4)])).joint("hinge")

    def residual(params):
        return (
            turned(pendulum(forces=[Motor(params["resistance"], params["current"])])).joint("hinge") - measured
        ) / 1e-3

    found = lx.fit(residual, {"resistance": 2.0, "current": 0.1}, progress=False)
    np.testing.assert_allclose([found.params["resistance"], found.params["current"]], [2.3, 0.4], rtol=1e-4)


class WithoutRates(lx.AbstractForce):
    @property
    def states(self):
        return {"x": lx.InternalState(0.0)}

    def load(self, t, motion, states):
        return lx.Load.none(motion.system)


class WithRates(WithoutRates):
    of: Callable = eqx.field(static=True)

    def rates(self, t, motion, states):
        return self.of(states["x"])


class NoStates(WithoutRates):
    @property
    def states(self):
        return {"x": 0.0}


@pytest.mark.parametrize(
    ("force", "message"),
    [
        (WithoutRates(), "WithoutRates has internal states, and no rates; define rates"),
        (WithRates(lambda x: {"y": 0.0}), "WithRates: its rates are of 'y'; give those of 'x'"),
        (WithRates(lambda x: {"x": jnp.zeros(2)}), "WithRates: the rate of 'x' has shape \\(2,\\)"),
        (NoStates(), "NoStates: state 'x' is 0.0; give a dictionary"),
    ],
)
def test_mistakes_are_told(force, message):
    with pytest.raises(ValueError, match=message):
        turned(pendulum(forces=[force]))


def test_a_rate_that_is_not_finite_is_told():
    with pytest.raises(lx.SimulationError, match="A rate of the internal states of WithRates is not finite"):
        turned(pendulum(forces=[WithRates(lambda x: {"x": 1.0 / x})]))


def test_states_are_asked_of_elements_that_have_them(driven):
    with pytest.raises(ValueError, match="Gravity' has no internal states; known: 'motor'"):
        driven.states("Gravity")
    with pytest.raises(KeyError, match="unknown internal state 'curent' \\(did you mean 'current'"):
        driven.states("motor")["curent"]
    with pytest.raises(ValueError, match=r"scale is -1\.0; it must be positive"):
        lx.InternalState(0.0, scale=-1.0)
    wrong = dataclasses.replace(driven.end, internal=jnp.zeros(2))
    with pytest.raises(ValueError, match=r"state\.internal has shape \(2,\)"):
        lx.simulate(driven.mechanism, wrong, t1=1.0)
    with pytest.raises(ValueError, match="no force element of this mechanism has internal states"):
        lx.simulate(pendulum(), driven.end, t1=1.0)


def test_a_mechanism_without_any_has_none():
    solution = turned(pendulum())
    assert solution.internal is None
    assert solution.end.internal is None


def test_inverse_dynamics_takes_states(driven):
    state = dataclasses.replace(driven.end, v=jnp.zeros(1))
    mechanism = driven.mechanism
    held = lx.inverse_dynamics(mechanism, state, {"hinge": 0.0}).forces["hinge"]
    gravity = 9.81 * 0.5 * np.cos(state.q[0])
    np.testing.assert_allclose(held, gravity - CONSTANT * state.internal[0])


def test_states_are_plotted(driven):
    figure = lx.plot.states(driven, "motor")
    (line,) = figure.axes[0].lines
    np.testing.assert_allclose(line.get_ydata(), driven.states("motor")["current"])
    assert figure.axes[0].get_ylabel() == "[A]"
