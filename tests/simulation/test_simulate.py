"""What simulate accepts, refuses, compiles, and returns."""

import weakref

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilations import compilations
from known_answers import mechanism_of
from mechanisms import crank_slider, pendulum

import linkax as lx
from linkax.cli import progress_run
from linkax.simulation.read.observables import Observables
from scalarjit.program import Scalarised

PENDULUM, START = pendulum(), lx.State(jnp.array([0.3]), jnp.zeros(1))


class Torque(lx.AbstractForce):
    """A torque of one's own."""

    torque: jax.Array

    def load(self, t, motion):
        none = lx.Load.none(motion.system)
        return none._replace(joint_force=self.torque + none.joint_force)


def test_other_numbers_compile_nothing_anew():
    def run(length, torque, angle, t1, rtol):
        mechanism = pendulum(length, forces=[Torque(jnp.asarray(torque))])
        state = lx.assemble(mechanism, {"hinge": angle})
        lx.simulate(mechanism, state, t1=t1, accuracy=lx.Accuracy(rtol=rtol))
        controller = diffrax.PIDController(rtol=rtol, atol=rtol)
        lx.simulate(mechanism, state, t1=t1, stepsize_controller=controller)

    run(1.0, 0.1, 0.2, 1.0, 1e-6)
    with compilations() as compiled:
        run(1.3, 0.2, 0.4, 2.0, 1e-7)
    assert not compiled


def test_poses_are_those_of_each_body():
    mechanism = crank_slider()
    found = lx.Solution.of_state(mechanism, lx.assemble(mechanism, {"bearing": 0.4}))
    assert list(found.poses()) == [body.name for body in mechanism.bodies]
    for name, pose in found.poses().items():
        np.testing.assert_allclose(pose.position, found.position(name, at=[0.0, 0.0, 0.0]), atol=1e-15)
        np.testing.assert_allclose(pose.orientation, found.orientation(name), atol=1e-15)


def test_optimise_is_deprecated():
    with pytest.warns(DeprecationWarning, match="optimise has no effect any more; leave it out"):
        lx.simulate(PENDULUM, START, t1=2.0, optimise=False)


def test_a_run_in_segments_is_the_run(monkeypatch):
    monkeypatch.setattr(progress_run, "LONG_RUN", 0.0)
    told, kept = [], []
    sensor = lx.FirstOrderSensor(lambda t, motion: motion.joint("hinge"), 0.3)  # which has an internal state
    mechanism = lx.Mechanism(PENDULUM.bodies, PENDULUM.joints, [*PENDULUM.forces, sensor])
    options = {"t1": 2.0, "accuracy": lx.PRECISE}
    found = progress_run.simulate_in_segments(
        mechanism, START, **options, report=lambda *now: told.append(now), keep=kept.append
    )
    assert told[-1] == ("integrating", pytest.approx(0.95))
    whole = lx.simulate(mechanism, START, saveat=diffrax.SaveAt(ts=found.solution.ts), **options)
    np.testing.assert_allclose(found.solution.ts, np.linspace(0.0, 2.0, 1001), rtol=1e-15)
    np.testing.assert_allclose([part.t_end for part in kept], np.linspace(0.0, 2.0, 21)[1:], rtol=1e-15)
    np.testing.assert_array_equal(kept[4].q, found.solution.q[:251])
    np.testing.assert_allclose(found.solution.q, whole.q, atol=1e-10)
    np.testing.assert_allclose(found.solution.internal, whole.internal, atol=1e-10)


def test_a_time_saved_more_than_once_holds_one_state():
    times = np.array([0.0, 0.5, 0.5, 1.0, 1.0, 1.0])
    run = lambda ts: lx.simulate(PENDULUM, START, t1=1.0, saveat=diffrax.SaveAt(ts=ts))
    found, each = run(times), run(np.unique(times))
    np.testing.assert_array_equal(found.ts, times)
    np.testing.assert_array_equal(found.q, np.asarray(each.q)[[0, 1, 1, 2, 2, 2]])
    # Traced ones change each by itself, as much as the polynomial between steps.
    change = jnp.zeros(6).at[2].set(1.0)
    moved = jax.jvp(lambda ts: run(ts).q, (jnp.asarray(times),), (change,))[1]
    expected = np.where(np.arange(6)[:, None] == 2, np.asarray(found.v), 0.0)
    np.testing.assert_allclose(moved, expected, rtol=1e-5)


def test_a_reading_is_computed_once(monkeypatch):
    computed = []
    found = lx.simulate(PENDULUM, START, t1=1.0)
    compute = Scalarised.__call__
    monkeypatch.setattr(
        Scalarised, "__call__", lambda self, of, *given: computed.append(of) or compute(self, of, *given)
    )
    first, again = found.reaction("hinge"), found.reaction("hinge")
    np.testing.assert_array_equal(first.force, again.force)
    assert computed == [Observables.solve, Observables.reactions]
    found.violation()
    assert computed[2:] == [Observables.violation_and_scales]
    kept = weakref.ref(found.rank())
    assert kept() is not None
    del found
    assert kept() is None


def test_a_batch_equals_single_runs():
    lengths = jnp.linspace(0.7, 1.6, 12)

    @eqx.filter_jit
    def run(length):
        mechanism = pendulum(length)
        return lx.simulate(mechanism, lx.assemble(mechanism, {"hinge": 0.3}), t1=1.0)

    batch = jax.vmap(run)(lengths)
    position, energy = batch.position("arm", at="tip"), batch.energy()
    assert position.shape == (12, 201, 3)
    for member, length in enumerate(lengths):
        single = run(length)
        np.testing.assert_allclose(position[member], single.position("arm", at="tip"), atol=1e-10)
        np.testing.assert_allclose(energy[member], single.energy(), atol=1e-9)
    assert batch.worst_violation().position.shape == (12,)


def test_a_member_that_fails_is_marked_and_harms_no_other():
    run = lambda angle: lx.simulate(PENDULUM, lx.State(jnp.array([1.0]) * angle, jnp.zeros(1)), t1=1.0)
    batch = jax.vmap(run)(jnp.array([0.3, jnp.nan, 0.5]))
    assert (batch.result == lx.RESULTS.successful).tolist() == [True, False, True]
    assert (batch.result == lx.RESULTS.not_finite).tolist() == [False, True, False]
    np.testing.assert_allclose(batch.q[0], run(0.3).q, atol=1e-10)


def test_max_steps_keeps_the_part_computed():
    with pytest.raises(lx.SimulationError, match=r"stopped at t = .* s: .*max_steps") as failure:
        lx.simulate(PENDULUM, START, t1=100.0, max_steps=64)
    solution = failure.value.solution
    assert solution.result == lx.RESULTS.max_steps_reached
    reached = np.isfinite(solution.ts)
    assert 1 < np.sum(reached) < 201
    assert 0.0 < solution.t_end < 100.0
    whole = lx.simulate(PENDULUM, START, t1=100.0)
    np.testing.assert_allclose(solution.q[reached], whole.q[reached], atol=1e-12)


@pytest.mark.parametrize(
    ("times", "ends"),
    [
        pytest.param([0.25, 0.5], {"t0": True}, marks=pytest.mark.slow),
        pytest.param([0.25, 0.5], {"t1": True}, marks=pytest.mark.slow),
        ([0.5], {"t0": True, "t1": True}),
    ],
)
def test_start_and_end_are_saved_beside_given_times(times, ends):
    found = lx.simulate(PENDULUM, START, t1=1.0, saveat=diffrax.SaveAt(ts=times, **ends))
    ts = [*[0.0] * ends.get("t0", False), *times, *[1.0] * ends.get("t1", False)]
    each = lx.simulate(PENDULUM, START, t1=1.0, saveat=diffrax.SaveAt(ts=ts))
    np.testing.assert_array_equal(found.ts, ts)
    np.testing.assert_allclose(found.q, each.q, atol=1e-14)
    np.testing.assert_allclose(found.v, each.v, atol=1e-14)
    assert found.error_estimate(lambda solution: solution.q).shape == found.q.shape


def test_every_step_saved_is_read_and_no_room_beyond():
    """Rows that were never saved are no numbers, and parts of the rows give what all at once give."""
    steps = diffrax.SaveAt(t0=True, steps=True)
    few, many = (lx.simulate(PENDULUM, START, t1=1.0, saveat=steps, max_steps=most) for most in (100, 1000))
    saved = 1 + int(many.stats["num_accepted_steps"])
    for found in (lambda run: run.q, lambda run: run.position("arm", at="tip"), lx.Solution.energy):
        of_few, of_many = found(few), found(many)
        assert np.all(np.isfinite(of_many[:saved]))
        assert not np.any(np.isfinite(of_many[saved:]))
        np.testing.assert_allclose(of_many[:saved], of_few[:saved], rtol=1e-14)
    assert jnp.issubdtype(many.rank().dtype, jnp.integer)
    assert many.reaction_unique("hinge").force.dtype == bool


def test_a_state_that_does_not_close_is_refused():
    mechanism = mechanism_of("crank-slider", changes={"rod": 0.2})
    with pytest.raises(lx.SimulationError, match=r"loops of the initial state do not close.*assemble"):
        lx.simulate(mechanism, lx.State(jnp.array([1.5, 0.5, 0.5]), jnp.zeros(3)), t1=5.0)


def test_functions_of_a_user_see_a_closed_state():
    saved = diffrax.SaveAt(ts=jnp.linspace(0.0, 1.0, 5), fn=lambda t, state, mechanism: state.q[0])
    event = diffrax.Event(lambda t, state, mechanism, **kwargs: state.q[0] < 0.0)
    found = lx.simulate(PENDULUM, START, t1=1.0, saveat=saved)
    np.testing.assert_allclose(found.ys, lx.simulate(PENDULUM, START, t1=1.0).q[::50, 0], atol=1e-7)
    with pytest.raises(ValueError, match="saved functions of its own"):
        found.position("arm")
    stopped = lx.simulate(PENDULUM, START, t1=10.0, event=event)
    assert stopped.result == lx.RESULTS.event_occurred
    assert stopped.t_end < 1.0


def test_dense_solutions_are_closed_between_steps():
    dense = lx.simulate(PENDULUM, START, t1=1.0, saveat=diffrax.SaveAt(dense=True), max_steps=512)
    plain = lx.simulate(PENDULUM, START, t1=1.0)
    np.testing.assert_allclose(dense.evaluate(plain.ts[77]).q, plain.q[77], atol=1e-8)
    with pytest.raises(ValueError, match=r"SaveAt\(dense=True\)"):
        plain.evaluate(0.5)


def test_unknown_names_in_accessors():
    found = lx.simulate(PENDULUM, START, t1=1.0)
    with pytest.raises(ValueError, match="unknown body 'crank'; known: 'arm'"):
        found.position("crank")
    with pytest.raises(ValueError, match="unknown joint or constraint 'pin'; known: 'hinge'"):
        found.reaction("pin")
    with pytest.raises(ValueError, match="body 'arm' has no frame 'bob'"):
        found.position("arm", at="bob")
