"""Starts in singular configurations, next to them, and anywhere."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from known_answers import mechanism_of, reference, rise_of_sarrus
from mechanisms import crank_slider, pendulum, raised, raised_exactly, sarrus
from scipy.optimize import brentq
from scipy.special import ellipeinc

import linkax as lx
from linkax.scenes import SCENES


class FreeCrankSlider:
    """Crank-slider of equal lengths and masses without gravity, where the energy integral gives time.

    ½ J(θ) θ̇² with J = 2/3 + 6 sin²θ stays one, so that t is an elliptic integral of θ.
    """

    duration = 2.0

    def __init__(self, angles, directions):
        self.angles, self.speeds = angles, directions * np.sqrt(2.0 / (2.0 / 3.0 + 6.0 * np.sin(angles) ** 2))
        mechanism = mechanism_of("crank-slider", "SC2")
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


MEMBERS = 400


def next_to_the_singular_configuration():
    generator = np.random.default_rng(0)
    distances = 10.0 ** generator.uniform(-14.0, -1.0, MEMBERS) * generator.choice([-1.0, 1.0], MEMBERS)
    return FreeCrankSlider(np.pi / 2 + distances, generator.choice([-1.0, 1.0], MEMBERS))


def anywhere():
    generator = np.random.default_rng(1)
    return FreeCrankSlider(generator.uniform(0.0, np.pi / 2, MEMBERS), np.ones(MEMBERS))


@pytest.mark.slow
@pytest.mark.parametrize("starts", [next_to_the_singular_configuration, anywhere])
def test_errors_of_many_starts_lie_on_one_curve(starts):
    starts = starts()
    exact = starts.exact()
    for rtol in (1e-6, 1e-10, 1e-13):
        found = starts.batch(rtol)
        assert np.all(found.result == lx.RESULTS.successful)
        tip, slider = found.position("crank", at="tip")[:, 0], found.position("slider")[:, 0]
        expected = np.stack([np.cos(exact), np.sin(exact)], axis=1)
        assert np.max(np.abs(slider[:, 0] - 2.0 * expected[:, 0])) <= 10.0 * rtol + 1e-11
        assert np.max(np.abs(tip[:, :2] - expected)) <= 5.0 * rtol + 1e-11


# The crank-slider with crank and rod on each other: the slider stands still, or moves.
UPRIGHT = {"bearing": np.pi / 2, "guide": 0.0}
Q_UPRIGHT = np.array([np.pi / 2, 0.0, -np.pi])


def upright(speeds):
    mechanism = mechanism_of("crank-slider", "SC1")
    return mechanism, lx.assemble(mechanism, UPRIGHT, speeds, guess={"crank_pin": -np.pi})


def told_of_branches(assembled, asked):
    """Mechanism and state, of whose speeds a warning tells that they fit several branches."""
    with pytest.warns(lx.AssemblyWarning, match="fit several branches") as told:
        found = assembled(asked)
    return *found, str(told[0].message)


def test_of_several_branches_one_is_taken_and_told():
    mechanism, state, _ = told_of_branches(upright, {"bearing": 1.0})
    np.testing.assert_allclose(state.v[mechanism.topology.speeds["guide"]], 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("speeds", "slider_speed"),
    [
        pytest.param({"bearing": 1.0}, 0.0, marks=pytest.mark.slow),
        pytest.param({"guide": -2.0}, -2.0, marks=pytest.mark.slow),
        ({"bearing": 1.0, "crank_pin": -2.0}, -2.0),
    ],
)
def test_speeds_are_completed_on_a_branch(speeds, slider_speed):
    mechanism, state = (
        upright(speeds) if len(speeds) > 1 or "guide" in speeds else told_of_branches(upright, speeds)[:2]
    )
    found = lx.simulate(mechanism, state, t1=0.5, accuracy=lx.PRECISE)
    of, q, v = mechanism.topology.coordinates, np.asarray(found.q), np.asarray(found.v)
    np.testing.assert_allclose(v[0, of["guide"]], slider_speed, atol=1e-12)
    slider, tip = q[:, of["guide"]], np.cos(q[:, of["bearing"]])
    np.testing.assert_allclose(slider, 2.0 * tip if slider_speed else 0.0 * tip, atol=1e-11)


@pytest.mark.slow
def test_derivatives_of_speeds_on_a_branch():
    """Of x = 2 l cos θ and its like, by the length of both rods and by the speed asked."""
    settings = SCENES["crank-slider"].settings("SC1", {})

    def speeds(length, speed):
        mechanism = SCENES["crank-slider"].mechanism(settings | {"crank": length, "rod": length})
        return lx.assemble(mechanism, UPRIGHT, {"guide": speed}, guess={"crank_pin": -np.pi}).v

    length, speed = jnp.asarray(1.5), jnp.asarray(-2.0)
    turns = np.array([-0.5, 0.0, 1.0]) / length
    exact = -speed / length * turns, turns + np.array([0.0, 1.0, 0.0])
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jax.jit(mode(speeds, (0, 1)))(length, speed), exact, atol=1e-12)


def test_speeds_on_no_branch_are_found_out():
    with pytest.raises(lx.AssemblyError, match=r"no branch.*'bearing', 'guide', 'crank_pin', 'wrist_pin'"):
        upright({"bearing": 1.0, "crank_pin": -1.0})
    between = lx.State(Q_UPRIGHT, np.array([1.0, -1.0, -1.0]))
    with pytest.raises(lx.SimulationError, match=r"before it began.*no branch.*'guide'") as failure:
        lx.simulate(mechanism_of("crank-slider", "SC1"), between, t1=0.5)
    assert failure.value.solution.result == lx.RESULTS.no_branch


def test_a_start_at_rest_that_is_not_unique_is_found_out():
    state = lx.State(Q_UPRIGHT, np.zeros(3))
    with pytest.raises(lx.SimulationError, match=r"at rest in a singular.*not unique.*'bearing'") as failure:
        lx.simulate(mechanism_of("crank-slider", "SC1"), state, t1=0.5)
    assert failure.value.solution.result == lx.RESULTS.not_unique
    # Without forces it stays, and that is unique.
    at_rest = lx.simulate(mechanism_of("crank-slider", "SC2"), state, t1=0.5)
    assert np.ptp(at_rest.q, axis=0) == pytest.approx(0.0, abs=1e-15)


def _motion(numbers, t):
    return numbers[0] + numbers[1] * t + numbers[2] * t**2


def started(mechanism_with, place, speed, acceleration, joint, guess):
    """The speeds that a drive makes, over its own, and how a run from there ends."""
    law = jax.tree_util.Partial(_motion, jnp.array([place, speed, acceleration / 2.0]))
    mechanism = mechanism_with(constraints=[lx.Drive("motor", joint, law)])
    state = lx.assemble(mechanism, guess=guess)
    found = lx.simulate(mechanism, state, t1=0.01, throw=False)
    if found.result == lx.RESULTS.successful:
        np.testing.assert_allclose(found.joint(joint)[-1], law(0.01), atol=1e-12)
    return state.v / speed, found.result


# Down to where squares vanish, and around what rounding leaves of speeds next to accelerations.
SLOW = np.array([1.0, -1e-2, 1e-4, -1e-5, 1e-6, 1e-7, -5e-8, 1e-8, 1e-12, -1e-20, 1e-100, 1e-155, 1e-200, -1e-300])
ACCELERATIONS = 20.0, -6.0, 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mechanism_with", "joint", "guess"),
    [(crank_slider, "bearing", {"bearing": 0.7, "crank_pin": -1.2, "guide": 1.8}), (pendulum, "hinge", None)],
)
def test_drives_that_start_slowly(mechanism_with, joint, guess):
    """As sin(ωt − π/2) does, whose speed at zero is rounding: a linkage moves at any speed as it does at any other."""
    starts = [(speed, acceleration) for acceleration in ACCELERATIONS for speed in SLOW]
    found = [started(mechanism_with, 0.7, *start, joint, guess) for start in starts]
    assert all(result == lx.RESULTS.successful for _, result in found)
    rates = np.array([rates for rates, _ in found])
    np.testing.assert_allclose(rates, np.broadcast_to(rates[0], rates.shape), rtol=1e-12)
    # At rest, too.
    assert started(mechanism_with, 0.7, 0.0, 20.0, joint, guess)[1] == lx.RESULTS.successful


def test_a_drive_may_start_as_sines_do():
    bent = {"bearing": 0.7, "crank_pin": -1.2, "guide": 1.8}
    for speed in (1.2e-16, 1e-5):
        assert started(crank_slider, 0.7, speed, 20.0, "bearing", bent)[1] == lx.RESULTS.successful


@pytest.mark.slow
def test_joints_that_start_slowly():
    mechanism = crank_slider()
    start = lambda speed: lx.assemble(mechanism, {"bearing": 0.7}, {"bearing": speed}, guess={"crank_pin": -1.2})
    rates = np.array([start(speed).v / speed for speed in SLOW])
    np.testing.assert_allclose(rates, np.broadcast_to(rates[0], rates.shape), rtol=1e-12)
    for speed in SLOW:
        assert lx.simulate(mechanism, start(speed), t1=0.01).result == lx.RESULTS.successful


@pytest.mark.slow
def test_a_slow_drive_in_a_singular_configuration_is_found_out():
    """Cranks of equal lengths upright: the slider, driven from rest, may move with them, or not."""
    upright = {"bearing": np.pi / 2, "crank_pin": -np.pi, "guide": 0.0}
    equal = lambda constraints: crank_slider(rod=1.0, constraints=constraints)
    for speed in SLOW:
        _, result = started(equal, 0.0, speed, 20.0, "guide", upright)
        expected = lx.RESULTS.successful if abs(speed) > 5e-7 else lx.RESULTS.not_unique
        assert result == expected


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "asked",
    [{"base_x": -5.0}, {"base_x": -5.0, "base_y": -5.0}, pytest.param({"base_y": 3.0}, marks=pytest.mark.slow)],
)
def test_speeds_of_some_joints_are_completed_to_a_branch(asked):
    """Sarrus with straight legs, where each leg can turn either way: y² = x²."""
    straight = lambda asked: raised(-np.pi / 2, asked)
    if len(asked) == 2:
        mechanism, state = straight(asked)
    else:
        mechanism, state, told = told_of_branches(straight, asked)
        joints = ("base", "knee", "top")
        assert all((f"'{name}_x'" in told) != (f"'{name}_y'" in told) for name in joints)
    solution = lx.Solution.of_state(mechanism, state)
    speeds = {name: float(solution.joint_speed(name)[0]) for name in ("base_x", "base_y")}
    for name, speed in asked.items():
        assert speeds[name] == pytest.approx(speed, rel=1e-12)
    assert abs(speeds["base_x"]) == pytest.approx(abs(speeds["base_y"]), rel=1e-9)


# At no height the rank falls by two, with straight legs by one; between, rows are neither clearly dependent nor not.
DISTANCES = np.array([0.0, 1e-13, 1e-9, 1e-8, 1e-7, 5e-7, 1e-6, 2e-6, 4e-6, 1e-5, 1e-4, 1e-2])
NEXT_TO = np.concatenate([angle + np.outer([1.0, -1.0], DISTANCES).ravel() for angle in (0.0, -np.pi / 2)])


def errors_of_starts(states, angles, speeds, rtol, duration=0.3):
    """Of both legs of Sarrus linkages after a run."""
    mechanism, saveat = sarrus(), diffrax.SaveAt(ts=np.array([duration]))
    run = lambda state: lx.simulate(
        mechanism, state, t1=duration, accuracy=lx.Accuracy(rtol=rtol), saveat=saveat, throw=False
    )
    found = jax.vmap(run)(jax.tree.map(lambda *leaves: jnp.stack(leaves), *states))
    assert np.all(found.result == lx.RESULTS.successful)
    exact = [rise_of_sarrus(angle, speed, duration) for angle, speed in zip(angles, speeds, strict=True)]
    legs = np.asarray(found.q)[:, 0, :2]  # base_x, base_y
    return np.max(np.abs(legs.T - exact), axis=0)


@pytest.mark.parametrize("rtol", [1e-8, *(pytest.param(rtol, marks=pytest.mark.slow) for rtol in (1e-5, 1e-12))])
def test_starts_at_any_distance_from_a_singular_configuration(rtol):
    speeds, mechanism = np.full(len(NEXT_TO), -5.0), sarrus()
    states = [raised_exactly(mechanism, angle, -5.0) for angle in NEXT_TO]
    assert np.max(errors_of_starts(states, NEXT_TO, speeds, rtol)) <= 100.0 * rtol


@pytest.mark.slow
def test_assembly_at_any_distance_from_a_singular_configuration():
    """Where the position tells the branch, one speed tells all; closer, that of a knee is asked too."""
    speed, states = -5.0, []
    for angle in NEXT_TO:
        told = np.min(np.abs(angle - np.array([0.0, -np.pi / 2]))) > 1e-9
        asked = {"base_x": speed} if told else {"base_x": speed, "base_y": speed, "knee_x": -2.0 * speed}
        states.append(raised(angle, asked)[1])
        exact = raised_exactly(sarrus(), angle, speed)
        np.testing.assert_allclose(states[-1].q, exact.q, atol=1e-14)
        np.testing.assert_allclose(states[-1].v, exact.v, atol=3e-9)
    assert np.max(errors_of_starts(states, NEXT_TO, np.full(len(NEXT_TO), speed), 1e-12)) <= 1e-10


@pytest.mark.slow
def test_many_starts_next_to_a_singular_configuration():
    """Assembled from positions and speeds of all joints but one, or of few, from guesses next to them."""
    generator, count, states = np.random.default_rng(2), 500, []
    distances = generator.choice([-1.0, 1.0], count) * 10.0 ** generator.uniform(-14.0, -1.0, count)
    angles = generator.choice([0.0, -np.pi / 2], count) + distances
    speeds = generator.choice([-1.0, 1.0], count) * generator.uniform(0.5, 6.0, count)
    for angle, distance, speed in zip(angles, distances, speeds, strict=True):
        asked = {"base_x": speed, "base_y": speed}
        if abs(distance) < 1e-7 or generator.integers(2):
            asked |= {"knee_x": -2.0 * speed}
        states.append(raised(angle, asked)[1])
    for rtol in (1e-5, 1e-8, 1e-12):
        assert np.max(errors_of_starts(states, angles, speeds, rtol)) <= 100.0 * rtol


@pytest.mark.slow
@pytest.mark.parametrize(("count", "starts"), [(1, 166), (2, 167), (3, 167)])
def test_many_starts_of_rows_of_loops_with_all_links_in_line(count, starts):
    """Against the pendulum that moves alike."""
    scene, generator, times = SCENES["n-four-bar"], np.random.default_rng(count), np.linspace(0.0, 0.5, 6)
    for rtol in np.repeat([1e-4, 1e-8, 1e-12], starts):
        distance = generator.choice([-1.0, 1.0]) * 10.0 ** generator.uniform(-14.0, -1.0)
        speed = generator.choice([-1.0, 1.0]) * generator.uniform(0.5, 6.0)
        asked = {"N": count, "angle": generator.choice([0.0, np.pi]) + distance, "speed": speed}
        settings = scene.settings("A02", asked)
        mechanism = scene.mechanism(settings)
        state = scene.initial(mechanism, settings)
        saveat = diffrax.SaveAt(ts=times)
        found = lx.simulate(mechanism, state, t1=0.5, accuracy=lx.Accuracy(rtol=rtol), saveat=saveat)
        expected = scene.exact(settings, times)["B0"]
        np.testing.assert_allclose(found.position("link_0", "tip"), expected, atol=100.0 * rtol, err_msg=str(asked))


@pytest.mark.parametrize("rtol", [1e-8, 1e-12])
def test_sarrus_through_seven_passages(rtol):
    """Redundant throughout; the rank falls by one and by two."""
    known = reference("sarrus")
    mechanism = sarrus()
    state = raised_exactly(mechanism, np.pi / 3, 0.0)
    found = lx.simulate(mechanism, state, t1=3.0, accuracy=lx.Accuracy(rtol=rtol), saveat=diffrax.SaveAt(ts=known["t"]))
    for name in ("base_x", "base_y"):
        leg = found.q[:, mechanism.topology.coordinates[name]]
        np.testing.assert_allclose(leg[:, 0], known["gamma"], atol=max(1e3 * rtol, 3e-9))


AFTER = np.linspace(0.0, 2e-3, 61)  # as many as in the table, so with the same program


def reactions_around(angle):
    """Forces and moments of all joints of Sarrus' linkage in motion: at an angle, and the means of before and after."""
    mechanism = sarrus()
    state = raised_exactly(mechanism, angle, -5.0)
    run = lambda sign: lx.simulate(
        mechanism, lx.State(state.q, sign * state.v), t1=2e-3, saveat=diffrax.SaveAt(ts=AFTER)
    )
    after, before = (run(sign).reactions() for sign in (1.0, -1.0))
    stack = lambda found: np.stack([np.concatenate(found[name], axis=-1) for name in sorted(found)], axis=1)
    return stack(after)[0], 0.5 * (stack(after) + stack(before))[[30, 60]]


def test_reactions_in_a_singular_configuration_are_limits():
    """With straight legs: the means of both sides, but for the square of the time, which Richardson takes off."""
    here, (near, far) = reactions_around(-np.pi / 2)
    size = np.max(np.abs(here))
    np.testing.assert_allclose(here, near, atol=2e-3 * size)
    np.testing.assert_allclose(here, (4.0 * near - far) / 3.0, atol=2e-5 * size)
    # Both legs alike, which least norms of the rows that are left in the configuration itself are not.
    base, other = here[:2]
    np.testing.assert_allclose(base[2], other[2], rtol=1e-7)


def test_reactions_that_grow_without_bound_are_not_numbers():
    """Folded legs turn freely about the platform's hinges: nothing there holds what gravity turns them by."""
    here, sides = reactions_around(0.0)
    assert not np.any(np.isfinite(here[:, :3]))
    assert np.all(np.isfinite(sides))
