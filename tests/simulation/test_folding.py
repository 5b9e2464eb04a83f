"""Linkages that fold, from many starts: all run, all passages are told, the error falls with the tolerance."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import TimeOfTurn, mechanism_of, start
from mechanisms import folded, folding, raised_exactly, sarrus

import linkax as lx

PRESETS = {"DRAFT": lx.DRAFT, "BALANCED": lx.BALANCED, "PRECISE": lx.PRECISE}
MOST = {"DRAFT": 1e-2, "BALANCED": 5e-7, "PRECISE": 2e-10}  # errors at the end [rad, m]
PASSAGES = 6


class Linkage(NamedTuple):
    """A linkage, its coordinates by the turn of one link with their slopes, and the turns below π where it is singular.

    - `least`: error that rounding leaves. `least_singular`: the same from a singular configuration, where a first stage
      does not know what rows of the loop will ask for.
    """

    mechanism: lx.Mechanism
    coordinates: object
    singular: np.ndarray
    least: float = 0.0
    least_singular: float = 0.0


def evenly(mechanism, state, one):
    """Coordinates of joints that turn evenly, from those at zero and the speeds of a turn of one."""
    return lambda turn: (state + np.multiply.outer(turn, one), np.broadcast_to(one, np.shape(turn) + np.shape(one)))


def _folding():
    mechanism = folding()
    return Linkage(mechanism, lambda turn: folded(mechanism, turn), np.zeros(1), 1e-9, 1e-7)


def _sarrus():
    mechanism = sarrus()
    zero = raised_exactly(mechanism, 0.0, 1.0)
    return Linkage(mechanism, evenly(mechanism, zero.q, zero.v), np.array([0.0, np.pi / 2]))


def _four_bars(count):
    mechanism = mechanism_of("n-four-bar", "A02", {"N": count})
    one = np.array([-1.0 if name.startswith("left") else 1.0 for name in mechanism.topology.coordinates])
    return Linkage(mechanism, evenly(mechanism, 0.0 * one, one), np.zeros(1))


def _crank_slider():
    mechanism = mechanism_of("crank-slider", "SC1")
    assert list(mechanism.topology.coordinates) == ["bearing", "guide", "crank_pin"]

    def coordinates(turn):
        q, slopes = [turn, 2.0 * np.cos(turn), -2.0 * turn], [1.0 + 0.0 * turn, -2.0 * np.sin(turn), -2.0 + 0.0 * turn]
        return np.stack(q, axis=-1), np.stack(slopes, axis=-1)

    return Linkage(mechanism, coordinates, np.array([np.pi / 2]))


LINKAGES = {
    "folding": _folding,
    "sarrus": _sarrus,
    "four-bar": lambda: _four_bars(1),
    "three four-bars": lambda: _four_bars(3),
    "crank-slider": _crank_slider,
}


def starts(linkage, count):
    """Turns where motions start, a third anywhere, a third close to a singular configuration, and a third in one."""
    generator = np.random.default_rng(0)
    close = generator.choice([-1.0, 1.0], count) * 10.0 ** np.where(
        np.arange(count) % 3 == 1, generator.uniform(-4.0, -1.0, count), generator.uniform(-14.0, -9.0, count)
    )
    singular = generator.choice(linkage.singular, count) + generator.choice([-np.pi, 0.0], count)
    turns = np.where(np.arange(count) % 3 == 0, generator.uniform(-np.pi, np.pi, count), singular + close)
    return zip(turns, generator.uniform(0.3, 3.0, count), generator.choice([-1.0, 1.0], count), strict=True)


def check(linkage, count):
    """Run from all starts, at all presets."""
    law = TimeOfTurn(linkage.mechanism, linkage.coordinates)
    every = np.unique(np.add.outer(linkage.singular, np.pi * np.arange(-20, 20)))
    for turn, above, sign in starts(linkage, count):
        energy = law.energy(above)
        clock = law.clock(energy)
        is_singular = np.min(np.abs(every - turn)) < 1e-6
        known = np.sort(sign * (clock(every[sign * (every - turn) > 1e-6]) - clock(turn)))[: PASSAGES + 1]
        duration = np.mean(known[-2:])
        end = law.turn(energy, clock(turn) + sign * duration)
        q, slopes = linkage.coordinates(np.array([turn, end]))
        state = lx.State(jnp.asarray(q[0]), jnp.asarray(sign * slopes[0] * law.speed(turn, energy)))
        for name, accuracy in PRESETS.items():
            told = f"{name} from {turn}, {sign}, energy {above}"
            found = lx.simulate(linkage.mechanism, state, t1=duration, accuracy=accuracy)
            assert np.max(np.abs(found.q[-1] - q[1])) <= max(
                MOST[name], linkage.least_singular if is_singular else linkage.least
            ), told
            times = found.passages().times
            assert len(times) == PASSAGES, told
            np.testing.assert_allclose(times, known[:-1], atol=1e-7 + 10.0 * accuracy.rtol, err_msg=told)


@pytest.mark.parametrize(("turn", "speed"), [(1e-7, 4.0), (0.0, 6.0), (1.0, 5.0), (2.0, 4.0), (0.5, 7.0)])
def test_a_linkage_that_folds_flat(turn, speed):
    """At the tightest tolerance, and without another branch."""
    mechanism = folding()
    q, slopes = folded(mechanism, turn)
    found = lx.simulate(mechanism, lx.State(q, slopes * speed), t1=5.0, accuracy=lx.PRECISE)
    first = found.q[:, mechanism.topology.coordinates["h1"]][:, 0]
    assert np.ptp(first) > 6.0 * np.pi
    np.testing.assert_allclose(found.q, folded(mechanism, first)[0], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", LINKAGES)
def test_many_starts_of_linkages_that_fold(name):
    check(LINKAGES[name](), 40)


@pytest.mark.slow
def test_many_starts_of_a_linkage_without_passages():
    """Bricard's, from states along its motion with other speeds, against runs that are more accurate."""
    mechanism, state = start("bricard")
    along = lx.simulate(mechanism, state, t1=4.0, accuracy=lx.PRECISE)
    for row, factor in zip(range(0, 200, 5), np.random.default_rng(0).uniform(0.5, 2.0, 40), strict=True):
        begin = lx.State(along.q[row], factor * along.v[row])
        found = {name: lx.simulate(mechanism, begin, t1=2.0, accuracy=preset) for name, preset in PRESETS.items()}
        assert all(len(one.passages().times) == 0 for one in found.values())
        ends = {name: one.q[-1] for name, one in found.items()}
        assert np.max(np.abs(ends["DRAFT"] - ends["PRECISE"])) <= MOST["DRAFT"]
        assert np.max(np.abs(ends["BALANCED"] - ends["PRECISE"])) <= MOST["BALANCED"]


@pytest.mark.parametrize("turn", [1e-2, 1e-4, 1e-6])
def test_a_guess_that_closes_the_loops_stays_as_it_is(turn):
    """To the last bit, though next to a singular configuration rounding of the loops allows other coordinates."""
    mechanism = folding()
    q, slopes = folded(mechanism, turn)
    names = list(mechanism.topology.coordinates)
    speeds = dict(zip(names, 4.0 * slopes, strict=True))
    for asked in (["h1"], ["h1", "h2", "h3"]):
        state = lx.assemble(
            mechanism, {}, {name: speeds[name] for name in asked}, guess=dict(zip(names, q, strict=True))
        )
        assert np.all(state.q == q)
        np.testing.assert_allclose(state.v, 4.0 * slopes, atol=1e-10)


@pytest.mark.parametrize("asked", [["h1"], ["h1", "h2"], ["h1", "h2", "h3"]])
def test_speeds_of_a_flat_linkage_are_completed_to_its_one_branch(asked):
    """Three equations for two speeds, whose search ends beside a solution from some starts."""
    mechanism = folding()
    speeds = 2.0 * folded(mechanism, 0.0)[1]
    given = {name: speeds[mechanism.topology.speeds[name]][0] for name in asked}
    np.testing.assert_allclose(lx.assemble(mechanism, {}, given).v, speeds, rtol=1e-9)


def test_derivatives_of_speeds_of_a_flat_linkage():
    mechanism = folding()
    slopes = jax.jacfwd(lambda speed: lx.assemble(mechanism, {}, {"h1": speed}).v)(2.0)
    np.testing.assert_allclose(slopes, folded(mechanism, 0.0)[1], rtol=1e-9)
