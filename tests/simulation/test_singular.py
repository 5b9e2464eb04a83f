"""Through singular configurations, from them, and next to them, at any tolerance."""

import itertools
from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import n_four_bar, reference
from scipy.optimize import brentq
from scipy.special import ellipeinc

import linkax as lx
from linkax.scenes import SCENES

TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-12, 1e-13)
ROUNDING = 1e-10  # what errors may differ between steps, where they do not fall
# Largest error over rtol: a factor for each family, from 1e-6 to 1e-13 alike. Its motions amplify
# rounding, a few 1e-13 at a passage, by as much.
GROWTH = {"crank-slider": 400.0, "n-four-bar": 2000.0}
PASSAGE = 2.5e-13


def start(name, variant, changes=None):
    scene = SCENES[name]
    settings = scene.settings(variant, changes)
    mechanism = scene.mechanism(settings)
    return mechanism, scene.initial(mechanism, settings)


def crank_slider_error(variant):
    known = reference(f"crank_slider_{variant}")
    return lambda found: np.abs(found.position("slider")[:, 0] - known["x_slider"])


def four_bar_error(variant, count):
    def error(found):
        turn = np.asarray(found.ts) + (np.pi / 2 if variant == "FL1" else 0.0)
        circle = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        exact = n_four_bar(found.ts, count) if variant == "A02" else circle
        return np.linalg.norm(found.position("link_0", at="tip")[:, :2] - exact, axis=-1)

    return error


RUNS = {f"SC{i}": ("crank-slider", f"SC{i}", None, 5.0, crank_slider_error(f"SC{i}")) for i in (1, 2, 3, 4)}
RUNS |= {name: ("n-four-bar", name, {"N": 1}, 10.0, four_bar_error(name, 1)) for name in ("FL1", "FL2")}
RUNS |= {f"A02-{n}": ("n-four-bar", "A02", {"N": n}, 10.0, four_bar_error("A02", n)) for n in (1, 2, 5, 10)}
MATRIX = [(diffrax.Dopri8(), name) for name in RUNS]
MATRIX += [
    (solver, name) for solver in (diffrax.Dopri5(), diffrax.Tsit5()) for name in RUNS if name[:2] in ("SC", "FL")
]
MATRIX += [(solver, "A02-1") for solver in (diffrax.Dopri5(), diffrax.Tsit5())]


@pytest.mark.parametrize(("solver", "name"), MATRIX, ids=[f"{type(s).__name__}-{name}" for s, name in MATRIX])
def test_tighter_tolerances_are_never_worse(solver, name):
    scene, variant, changes, t1, error = RUNS[name]
    mechanism, state = start(scene, variant, changes)
    errors, steps = [], []
    for rtol in TOLERANCES:
        found = lx.simulate(mechanism, state, t1=t1, accuracy=lx.Accuracy(rtol=rtol), solver=solver)
        errors.append(np.max(error(found)))
        steps.append(int(found.stats["num_steps"]))
    rounding = GROWTH[scene] * PASSAGE
    assert all(tighter <= looser + rounding for looser, tighter in itertools.pairwise(errors)), errors
    # On the branch, at every tolerance: a run that leaves it is wrong by the size of the mechanism.
    assert np.all(errors <= GROWTH[scene] * np.array(TOLERANCES) + rounding), errors
    if solver.order(None) == 8:
        assert steps[3] <= 3 * steps[2]


class RK4(diffrax.AbstractERK):
    """The classical method, without an error estimate."""

    tableau: ClassVar = diffrax.ButcherTableau(
        c=np.array([0.5, 0.5, 1.0]),
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
        b_error=np.array([1.0, 2.0, 2.0, 1.0]) / 6.0 - np.array([1.0, 0.0, 0.0, 0.0]),
    )
    interpolation_cls: ClassVar = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms):
        return 4


@pytest.mark.parametrize("solver", [RK4(), diffrax.Dopri8()], ids=["RK4", "Dopri8"])
@pytest.mark.parametrize("name", ["SC2", "FL1"])
def test_smaller_fixed_steps_are_never_worse(solver, name):
    scene, variant, changes, _, error = RUNS[name]
    mechanism, state = start(scene, variant, changes)
    errors = []
    for step in (10e-3, 5e-3, 2e-3, 1e-3, 0.5e-3):
        fixed = diffrax.ConstantStepSize()
        found = lx.simulate(mechanism, state, t1=5.0, dt0=step, solver=solver, stepsize_controller=fixed)
        errors.append(np.max(error(found)))
    assert all(finer <= coarser + ROUNDING for coarser, finer in itertools.pairwise(errors)), errors
    assert errors[-1] <= ROUNDING


class FreeCrankSlider:
    """Crank-slider of equal lengths and masses without gravity, where the energy integral gives time.

    ½ J(θ) θ̇² with J = 2/3 + 6 sin²θ stays one, so that t is an elliptic integral of θ.
    """

    duration = 2.0

    def __init__(self, angles, directions):
        self.angles, self.speeds = angles, directions * np.sqrt(2.0 / (2.0 / 3.0 + 6.0 * np.sin(angles) ** 2))
        mechanism, _ = start("crank-slider", "SC2")
        coordinates = {"bearing": angles, "crank_pin": -2.0 * angles, "guide": 2.0 * np.cos(angles)}
        rates = {
            "bearing": self.speeds,
            "crank_pin": -2.0 * self.speeds,
            "guide": -2.0 * np.sin(angles) * self.speeds,
        }
        names = list(mechanism.topology.coordinates)
        self.mechanism = mechanism
        self.q = np.stack([coordinates[name] for name in names], axis=1)
        self.v = np.stack([rates[name] for name in names], axis=1)

    def run(self, q, v, accuracy):
        saveat = diffrax.SaveAt(ts=np.array([self.duration]))
        state, t1 = lx.State(q, v), self.duration
        return lx.simulate(self.mechanism, state, t1=t1, accuracy=accuracy, saveat=saveat, throw=False)

    def batch(self, rtol):
        return jax.vmap(self.run, (0, 0, None))(self.q, self.v, lx.Accuracy(rtol=rtol))

    def exact(self):
        time = lambda angle: np.sqrt(1.0 / 3.0) * ellipeinc(angle, -9.0)
        ends = zip(self.angles, np.sign(self.speeds) * self.duration, strict=True)
        find = lambda a, t: brentq(lambda angle: time(angle) - time(a) - t, a - 8.0, a + 8.0, xtol=1e-15, rtol=1e-15)
        return np.array([find(angle, elapsed) for angle, elapsed in ends])


MEMBERS = 1000


def next_to_the_singular_configuration():
    generator = np.random.default_rng(0)
    distances = 10.0 ** generator.uniform(-14.0, -1.0, MEMBERS) * generator.choice([-1.0, 1.0], MEMBERS)
    return FreeCrankSlider(np.pi / 2 + distances, generator.choice([-1.0, 1.0], MEMBERS))


def anywhere():
    generator = np.random.default_rng(1)
    return FreeCrankSlider(generator.uniform(0.0, np.pi / 2, MEMBERS), np.ones(MEMBERS))


@pytest.mark.parametrize("starts", [next_to_the_singular_configuration, anywhere])
def test_errors_of_many_starts_lie_on_one_curve(starts):
    starts = starts()
    exact = starts.exact()
    for rtol in TOLERANCES:
        found = starts.batch(rtol)
        assert np.all(found.result == lx.RESULTS.successful)
        tip, slider = found.position("crank", at="tip")[:, 0], found.position("slider")[:, 0]
        expected = np.stack([np.cos(exact), np.sin(exact)], axis=1)
        assert np.max(np.abs(slider[:, 0] - 2.0 * expected[:, 0])) <= 10.0 * rtol + 1e-11
        assert np.max(np.abs(tip[:, :2] - expected)) <= 5.0 * rtol + 1e-11


def test_members_of_a_batch_equal_single_runs():
    starts = anywhere()
    together = starts.batch(1e-12)
    alone = [starts.run(q, v, lx.PRECISE).q for q, v in zip(starts.q, starts.v, strict=True)]
    assert np.max(np.abs(together.q - np.stack(alone))) <= 1e-10


def test_a_motion_far_from_singular_is_the_same_without_the_clearance():
    mechanism, state = start("crank-slider", "regular")
    with_it, without = (
        lx.simulate(mechanism, state, t1=2.0, accuracy=lx.Accuracy(clearance=clearance)) for clearance in (1e-2, 0.0)
    )
    assert with_it.stats["num_steps"] == without.stats["num_steps"]
    np.testing.assert_array_equal(with_it.q, without.q)


def test_a_long_run_stays_on_its_branch():
    """More than a thousand passages; 10 000 s are in benchmarks/singular_passages.py."""
    mechanism, state = start("n-four-bar", "A02", {"N": 1})
    found = lx.simulate(mechanism, state, t1=1000.0)
    angles = np.stack([found.joint(f"pivot_{i}") for i in range(2)])
    assert np.max(np.abs(angles[0] - angles[1])) <= 1e-9
    position, velocity, acceleration = found.worst_violation()
    assert max(position, velocity, acceleration) <= 1e-12


# The crank-slider with crank and rod on each other: the slider stands still, or moves.
UPRIGHT = {"bearing": np.pi / 2, "guide": 0.0}


def upright(speeds):
    mechanism, _ = start("crank-slider", "SC1")
    return mechanism, lx.assemble(mechanism, UPRIGHT, speeds, guess={"crank_pin": -np.pi})


@pytest.mark.parametrize(
    ("speeds", "slider_speed"),
    [({"bearing": 1.0}, 0.0), ({"guide": -2.0}, -2.0), ({"bearing": 1.0, "crank_pin": -2.0}, -2.0)],
)
def test_speeds_are_completed_on_a_branch(speeds, slider_speed):
    mechanism, state = upright(speeds)
    found = lx.simulate(mechanism, state, t1=0.5, accuracy=lx.PRECISE)
    np.testing.assert_allclose(found.joint_speed("guide")[0], slider_speed, atol=1e-12)
    slider, tip = found.position("slider")[:, 0], found.position("crank", at="tip")[:, 0]
    np.testing.assert_allclose(slider, 2.0 * tip if slider_speed else 0.0 * tip, atol=1e-11)


def test_speeds_on_no_branch_are_found_out():
    with pytest.raises(lx.AssemblyError, match=r"lie on no branch.*'bearing', 'guide', 'crank_pin', 'wrist_pin'"):
        upright({"bearing": 1.0, "guide": -1.0})
    mechanism, state = upright({"guide": -2.0})
    between = lx.State(state.q, state.v * jnp.array([1.0, 0.5, 0.5]))
    with pytest.raises(lx.SimulationError, match=r"before it began.*no branch.*'guide'") as failure:
        lx.simulate(mechanism, between, t1=0.5)
    assert failure.value.solution.result == lx.RESULTS.no_branch


def test_a_start_at_rest_that_is_not_unique_is_found_out():
    mechanism, state = upright({})
    with pytest.raises(lx.SimulationError, match=r"at rest in a singular.*not unique.*'bearing'") as failure:
        lx.simulate(mechanism, state, t1=0.5)
    assert failure.value.solution.result == lx.RESULTS.not_unique
    # Without forces it stays, and that is unique.
    mechanism, _ = start("crank-slider", "SC2")
    assert np.ptp(lx.simulate(mechanism, state, t1=0.5).q, axis=0) == pytest.approx(0.0, abs=1e-15)


def test_in_a_batch_a_start_without_branch_harms_no_other():
    starts = anywhere()
    undisturbed = starts.batch(1e-8)
    _, state = upright({"guide": -2.0})
    starts.q[7], starts.v[7] = state.q, state.v * np.array([1.0, 0.5, 0.5])
    starts.v[8] = np.nan
    found = starts.batch(1e-8)
    assert np.flatnonzero(found.result == lx.RESULTS.no_branch).tolist() == [7]
    assert np.flatnonzero(found.result == lx.RESULTS.not_finite).tolist() == [8]
    assert found.stats["num_steps"][7:9].tolist() == [1, 1]
    others = np.flatnonzero(found.result == lx.RESULTS.successful)
    assert len(others) == MEMBERS - 2
    # Not to the last digit, as diffrax takes up no stage of a step's predecessor while a member lacks it.
    np.testing.assert_allclose(found.q[others], undisturbed.q[others], atol=1e-9)
    with pytest.raises(ValueError, match="passages of a batch"):
        found.passages()


@pytest.mark.parametrize("variant", ["SC1", "SC2", "SC3", "SC4"])
def test_passages_are_told(variant):
    known = reference(f"crank_slider_{variant}")
    mechanism, state = start("crank-slider", variant)
    found = lx.simulate(mechanism, state, t1=5.0, accuracy=lx.PRECISE)
    passages = found.passages()
    # The angle crosses odd multiples of 90 degrees; where, by inverse interpolation of the table.
    quarter = np.floor(known["theta"] / np.pi - 0.5)
    before = np.flatnonzero(np.diff(quarter))
    assert len(passages.times) == len(before)
    assert np.all(known["t"][before] <= passages.times)
    assert np.all(passages.times <= known["t"][before + 1])
    crossed = np.pi * (np.maximum(quarter[before], quarter[before + 1]) + 0.5)
    speed = (known["theta"][before + 1] - known["theta"][before]) / np.diff(known["t"])[before]
    linear = known["t"][before] + (crossed - known["theta"][before]) / speed
    np.testing.assert_allclose(passages.times, linear, atol=2e-3)
    error = np.max(crank_slider_error(variant)(found))
    assert 2.0 <= passages.digits <= 4.0
    assert error <= 1e-11 + np.finfo(float).eps * 10.0**passages.digits * 1e3
    # Near at the times of passages alone.
    near = np.flatnonzero(found.singularity_distance() < 0.05)
    assert np.all(np.min(np.abs(np.subtract.outer(known["t"][near], passages.times)), axis=1) < 0.05)
    assert np.median(found.singularity_distance()) > 0.1


def test_a_start_in_a_singular_configuration_is_at_distance_zero():
    mechanism, state = start("n-four-bar", "FL2")
    found = lx.simulate(mechanism, state, t1=10.0)
    assert found.rank_nearby == 2
    assert found.rank()[0] == 1
    assert found.singularity_distance()[0] <= 1e-15


def test_a_motion_without_passages_tells_none():
    mechanism, state = start("crank-slider", "regular")
    found = lx.simulate(mechanism, state, t1=2.0)
    passages = found.passages()
    assert len(passages.times) == 0
    assert passages.digits < 1.0
