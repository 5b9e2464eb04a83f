"""States that are given out lie on the loops, on their own branch, however long the steps; else the run fails there."""

from math import pi

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanisms import crank_slider, down, four_bar

import linkax as lx
from linkax.equations.system import system_of

CLOSED = 1e-9  # radians, or lengths of the loop
KINDS = 1707  # members of each of six kinds: ten thousand mechanisms in all
NUMBERS = 6  # random numbers of a mechanism, in [0, 1]
FAILURES = (lx.RESULTS.not_assembled, lx.RESULTS.locked, lx.RESULTS.dt_min_reached, lx.RESULTS.max_steps_reached)


def motor(joint, speed, driven):
    return [lx.Drive("motor", joint, speed=speed)] if driven else []


def assembled(mechanism, joint, angle, speed, guess, driven):
    if driven:
        return lx.assemble(mechanism, guess=guess)
    return lx.assemble(mechanism, {joint: angle}, {joint: speed}, guess=guess)


def shaper(n, driven):
    """A quick-return mechanism."""
    crank, lever, link = lx.rod("crank", 0.05 + 0.15 * n[0], 1.0), lx.rod("lever", 0.75, 1.0), lx.rod("link", 0.35, 1.0)
    block, ram = lx.point_mass("block", 1.0), lx.point_mass("ram", 1.0)
    joints = [
        lx.Revolute("O2", lx.GROUND.at(jnp.array([0.0, 1.0, 0.0]) * (0.22 + 0.2 * n[1])), crank.at("base"), axis="z"),
        lx.Revolute("A", crank.at("tip"), block, axis="z"),
        lx.Prismatic("slot", lever.at("base"), block, axis="x"),
        lx.Revolute("O4", lx.GROUND, lever.at("base"), axis="z"),
        lx.Revolute("B", lever.at("tip"), link.at("base"), axis="z"),
        lx.Revolute("C", link.at("tip"), ram, axis="z"),
        lx.Prismatic("guide", lx.GROUND.at([0.0, 0.7, 0.0]), ram, axis="x"),
    ]
    speed = 2.0 * pi * (0.5 + 1.5 * n[4])
    mechanism = lx.Mechanism([crank, block, lever, link, ram], joints, [down(9.81)], motor("O2", speed, driven))
    guess = {"O4": pi / 2.0 - 0.3, "slot": 0.4, "A": 1.0, "B": 1.5, "guide": -0.2}
    return mechanism, assembled(mechanism, "O2", 0.0, speed, guess, driven)


def planar(n, driven):
    """A four-bar, which may not turn all the way round."""
    lengths = dict(crank=0.15 + 0.35 * n[0], coupler=0.6 + 0.6 * n[1], rocker=0.6 + 0.6 * n[2], ground=0.8 + 0.4 * n[3])
    speed = 2.0 + 6.0 * n[4]
    mechanism = four_bar(**lengths, constraints=motor("crank_bearing", speed, driven))
    guess = {"crank_pin": 0.5, "rocker_bearing": 1.5}
    return mechanism, assembled(mechanism, "crank_bearing", 6.0 * n[5], speed, guess, driven)


def spatial(n, driven):
    """A crank and a rocker about skew axes, with a coupler between balls."""
    crank, rocker = lx.rod("crank", 0.15 + 0.3 * n[0], 1.0), lx.rod("rocker", 0.6 + 0.6 * n[2], 1.0)
    coupler = lx.rod("coupler", 0.8 + 0.8 * n[1], 1.0, thickness=0.1)
    far = lx.GROUND.at(jnp.array([1.0, 0.0, 0.3]) * (0.8 + 0.4 * n[3]))
    joints = [
        lx.Revolute("bearing", lx.GROUND, crank.at("base"), axis="z"),
        lx.Spherical("near", crank.at("tip"), coupler.at("base")),
        lx.Spherical("far", coupler.at("tip"), rocker.at("tip")),
        lx.Revolute("pivot", far, rocker.at("base"), axis=[0.3, 1.0, 0.1]),
    ]
    speed = 2.0 + 6.0 * n[4]
    mechanism = lx.Mechanism([crank, coupler, rocker], joints, [down(9.81)], motor("bearing", speed, driven))
    return mechanism, assembled(mechanism, "bearing", 6.0 * n[5], speed, {"pivot": -1.0}, driven)


@pytest.mark.slow
@pytest.mark.parametrize("driven", [True, False])
@pytest.mark.parametrize("kind", [shaper, planar, spatial])
def test_of_ten_thousand_mechanisms_no_state_is_off_its_loops(kind, driven):
    """Driven ones lie where a run at a tight tolerance has them: no state has gone to another branch.

    Of the coupler between balls the loops leave the spin free, so of these the tips are compared.
    """
    saves = {shaper: 61, planar: 1001, spatial: 201}[kind]
    ts = np.linspace(0.0, 2.0, 61 if driven else saves)

    def run(numbers, rtol):
        options = dict(t1=2.0, accuracy=lx.Accuracy(rtol=rtol), saveat=diffrax.SaveAt(ts=ts), throw=False)
        mechanism, state = kind(numbers, driven)
        found = lx.simulate(mechanism, state, **options)
        tips = [found.position(body.name, at="tip") for body in mechanism.bodies] if kind is spatial else []
        determined = jnp.concatenate(tips, axis=-1) if tips else found.q
        return found.worst_violation().position, found.result, found.t_end, determined

    runs = jax.jit(jax.vmap(run))
    numbers = np.random.default_rng(0).uniform(size=(KINDS, NUMBERS))
    violation, result, t_end, q = runs(numbers, np.resize([1e-2, 1e-3, 1e-4, 1e-5], KINDS))
    well = np.asarray(result == lx.RESULTS.successful)
    told = np.any([np.asarray(result == one) for one in FAILURES], axis=0)
    assert np.all(well | told)
    assert np.mean(well) > 0.7
    assert np.max(violation) < CLOSED
    assert np.all(np.isfinite(q[well]))
    assert np.all(np.isfinite(t_end))
    if driven:
        exact = np.asarray(runs(numbers, np.full(KINDS, 1e-10))[-1])
        reached = np.isfinite(q) & np.isfinite(exact)
        np.testing.assert_allclose(np.where(reached, q, 0.0), np.where(reached, exact, 0.0), atol=1e-7)


def test_steps_of_a_driven_mechanism_follow_its_loops():
    """Errors of steps know nothing of them: all motion is prescribed."""
    numbers = np.array([0.7643, 0.0818, 0.0, 0.0, 1.0 / 3.0, 0.0])
    mechanism, state = shaper(numbers, True)
    ts = np.linspace(0.0, 1.0, 61)
    run = lx.simulate(mechanism, state, t1=1.0, accuracy=lx.Accuracy(rtol=1e-2), saveat=diffrax.SaveAt(ts=ts))
    assert run.worst_violation().position < CLOSED
    np.testing.assert_allclose(run.joint("O2"), 2.0 * pi * ts, atol=1e-9)
    assert np.max(np.abs(run.joint("guide"))) < 1.0


@pytest.fixture(scope="module")
def turning():
    """A crank-slider, driven one turn a second, with its state at the start."""
    mechanism = crank_slider(crank=0.4, constraints=motor("bearing", 2.0 * pi, True))
    return mechanism, lx.assemble(mechanism, guess={"guide": 1.6})


def test_long_steps_of_fixed_size_fail_where_they_open_the_loops(turning):
    steps = dict(dt0=1.0, stepsize_controller=diffrax.ConstantStepSize())
    run = lx.simulate(*turning, t1=2.0, throw=False, **steps)
    assert run.result == lx.RESULTS.diverged
    assert run.t_end == 0.0
    with pytest.raises(lx.SimulationError, match="far off the loops"):
        lx.simulate(*turning, t1=2.0, **steps)


def test_states_between_saved_times_are_on_the_loops_or_refused(turning):
    run = lx.simulate(*turning, t1=2.0, saveat=diffrax.SaveAt(ts=np.linspace(0.0, 2.0, 41)))
    assert run.at([0.123, 1.234]).worst_violation().position < CLOSED
    few = lx.simulate(*turning, t1=2.0, saveat=diffrax.SaveAt(ts=np.linspace(0.0, 2.0, 2)))
    with pytest.raises(ValueError, match=r"not known at t = 0.25 s.* save more often"):
        few.at([0.25])
    assert np.all(np.isposinf(jax.jit(lambda t: few.at(t).q)(jnp.array([0.25]))))


def test_a_state_that_closes_far_away_is_marked(turning):
    """The class of a saved state whose correction leads to another place."""
    mechanism, state = turning
    method, system = lx.TangentSpace().prepared(np.dtype(float)), system_of(mechanism, np.dtype(float))
    for away, holds in ((1e-3, True), (0.5, False)):
        q, _, found = method.close_near(system, 0.0, state.q + away * np.array([0.0, 1.0, 0.0]), state.v)
        assert bool(found) == holds
        assert np.all(np.isfinite(q))
