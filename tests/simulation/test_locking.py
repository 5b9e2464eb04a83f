"""Driven mechanisms that lock end there, soon and by name, and those that turn back before, or just pass, go on."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import crank_slider, four_bar

import linkax as lx
from linkax.simulation.integrate.placement import lock_ahead

NODES = np.array([0.25, 0.5, 0.75, 1.0])
PRESETS = {"draft": lx.DRAFT, "balanced": lx.BALANCED, "precise": lx.PRECISE}
END = diffrax.SaveAt(t1=True)
CRANK, ROD = 0.5, 0.4
LOCKS = float(np.arcsin(ROD / CRANK))  # where the rod of a longer crank stands across its slide


def sample(distance):
    """d where a step begins, at its stages, and where it ends."""
    return tuple(jnp.asarray(distance(at)) for at in (0.0, NODES, 1.0))


@pytest.mark.parametrize("time", [1.1, 1.5, 3.0])
def test_d_squared_on_a_straight_line_locks(time):
    """With speeds that grow like 1/d; one that passes, at the distance `least`, does not, at whatever speed."""
    begin, stages, end = sample(lambda t: 0.005 * np.sqrt(1.0 - t / time))
    np.testing.assert_allclose(lock_ahead(NODES, begin, stages, end, begin / end), time - 1.0, rtol=1e-9)
    assert lock_ahead(NODES, begin, stages, end, jnp.asarray(1.0)) == 0.0
    for least in (0.0, 1e-4, 1e-2):
        begin, stages, end = sample(lambda t, least=least: np.sqrt(least**2 + (0.005 * (1.0 - t / time)) ** 2))
        for growth in (1.0, begin / end):
            assert lock_ahead(NODES, begin, stages, end, jnp.asarray(growth)) == 0.0


def driven(turning):
    """A crank-slider whose crank is longer than its rod, driven by an angle."""
    mechanism = crank_slider(crank=CRANK, rod=ROD, constraints=[lx.Drive("motor", "bearing", turning)])
    return mechanism, lx.assemble(mechanism, guess={"guide": 0.8})


@pytest.mark.parametrize("preset", PRESETS)
def test_a_run_ends_where_its_mechanism_locks(preset):
    mechanism, start = driven(lambda t: 3.0 * t)
    with pytest.raises(lx.SimulationError, match=r"locks.*drive 'motor' of joint 'bearing' asks for what the") as error:
        lx.simulate(mechanism, start, t1=2.0, saveat=END, accuracy=PRESETS[preset])
    run = error.value.solution
    assert run.result == lx.RESULTS.locked
    np.testing.assert_allclose(run.t_end, LOCKS / 3.0, rtol=1e-3)
    assert run.stats["num_steps"] < 60


@pytest.mark.slow
@pytest.mark.parametrize("preset", PRESETS)
def test_a_drive_that_turns_back_before_does_not_lock(preset):
    """At full speed, of random lengths: distances are square roots of margins, and beyond zero is another branch."""

    def run(numbers, margin):
        crank, rod, time = numbers
        highest = jnp.arcsin(rod / crank) - margin
        turning = lx.PiecewiseLinear(time * jnp.array([0.0, 0.5, 1.0]), jnp.stack([0.0, highest, 0.0]))
        mechanism = crank_slider(crank=crank, rod=rod, constraints=[lx.Drive("motor", "bearing", turning)])
        start = lx.assemble(mechanism, guess={"guide": crank + rod})
        saveat = diffrax.SaveAt(ts=time * jnp.array([0.5, 1.0]))
        found = lx.simulate(mechanism, start, t1=time, saveat=saveat, accuracy=PRESETS[preset], throw=False)
        off = found.joint("bearing") - jnp.stack([highest, 0.0]), found.joint("guide")[1] - (crank + rod)
        return found.result == lx.RESULTS.successful, *off, found.stats["num_steps"]

    margins = 10.0 ** -np.concatenate([[3.0, 5.0, 7.0, 9.0], np.linspace(2.0, 9.0, 60)])
    random = np.random.default_rng(0).uniform([0.4, 0.4, 0.1], [0.6, 0.95, 1.0], (64, 3))
    numbers = np.stack([random[:, 0], random[:, 0] * random[:, 1], random[:, 2]], axis=1)
    went_well, of_bearing, of_guide, steps = jax.jit(jax.vmap(run))(numbers, margins)
    assert np.all(went_well)
    np.testing.assert_allclose(of_bearing, 0.0, atol=1e-9)
    np.testing.assert_allclose(of_guide, 0.0, atol=1e-6)
    assert np.max(steps) < 120


@pytest.mark.slow
@pytest.mark.parametrize("margin", [1e-6, 1e-4])
def test_a_drive_that_nearly_locks_is_right_or_its_error_tells(margin):
    """It turns back smoothly, with no speed of its own there: within its tolerance it passes to another branch."""
    mechanism, start = driven(lambda t: (LOCKS - margin) * jnp.sin(jnp.pi * t / 0.6))
    run = lx.simulate(mechanism, start, t1=0.6)
    off = abs(run.joint("guide")[-1] - (CRANK + ROD))
    assert off < 1e-6 or np.max(run.error_estimate()) > 0.5 * off
    assert off < 1e-6 or margin < 1e-5
    assert np.all((run.passages().times > 0.0) & (run.passages().times < 0.6))


@pytest.mark.slow
def test_members_that_lock_hold_up_no_sweep():
    """They take little more steps than others, and have the result of a run alone."""

    def run(lengths):
        crank, coupler, rocker = lengths
        drive = lx.Drive("motor", "crank_bearing", speed=4.0)
        mechanism = four_bar(crank=crank, coupler=coupler, rocker=rocker, ground=1.0, constraints=[drive])
        start = lx.assemble(mechanism, guess={"crank_pin": 0.5, "rocker_bearing": 1.5})
        return lx.simulate(mechanism, start, t1=2.0, saveat=END, throw=False)

    lengths = np.random.default_rng(0).uniform([0.15, 0.5, 0.5], [0.5, 1.2, 1.2], (64, 3))
    crank, coupler, rocker = lengths.T
    found = jax.jit(jax.vmap(run))(lengths)
    # The crank turns all the way round where it and any other link are no longer than the other two (Grashof).
    spans = np.stack([np.ones(64), crank, coupler, rocker])
    turns = (2.0 * (spans.min(axis=0) + spans.max(axis=0)) <= spans.sum(axis=0)) & (crank <= spans.min(axis=0))
    assembles = (1.0 - crank < coupler + rocker) & (np.abs(coupler - rocker) < 1.0 - crank)
    steps, locks = np.asarray(found.stats["num_steps"]), np.asarray(found.result == lx.RESULTS.locked)
    assert 8 < np.sum(turns) < 56
    np.testing.assert_array_equal(found.result == lx.RESULTS.successful, turns & assembles)
    np.testing.assert_array_equal(found.result == lx.RESULTS.not_assembled, ~assembles)
    np.testing.assert_array_equal(locks, assembles & ~turns)
    assert np.max(steps) <= 3 * np.max(steps[turns & assembles])
    assert run(lengths[np.argmax(locks)]).result == lx.RESULTS.locked
