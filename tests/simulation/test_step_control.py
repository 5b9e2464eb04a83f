"""The step control, on steps that are made up; when implicit steps are given up; what chooses the steps is told."""

from contextlib import nullcontext
from functools import partial
from types import SimpleNamespace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from mechanisms import pendulum

import linkax as lx
from linkax.scenes import SCENES
from linkax.simulation.integrate.diffrax_contract import StepError
from linkax.simulation.integrate.placement import GROWTH, Placement
from linkax.simulation.integrate.projected_solver import Chord
from linkax.simulation.integrate.step_control import AMPLIFIED, MechanismControl

SCALES = jnp.array([1.0, 1e3])
ARGS = SimpleNamespace(
    system=SimpleNamespace(scales=SCALES, fastest=lambda v: jnp.max(jnp.abs(v / SCALES))),
    accuracy=lx.Accuracy(rtol=1e-8),
    method=lx.TangentSpace().prepared(float),
    unpacked=lambda y: (y[:2], y[2:4]),
    internal=lambda y: None,
    scales=(SCALES, SCALES),
    can_go_on=lambda t, y: True,
    times=None,
)
Y = jnp.array([1.0, 2e3, 3.0, 4e3, 0.0])
ONE = jnp.asarray(1.0)
FAR = StepError((jnp.zeros(2), jnp.zeros(2)), ONE, Placement(ONE, jnp.inf * ONE, 0.5 * ONE, ONE))


def near(passes=1.0, follows=np.inf, gains=0.1, leaves=1.0, errors=FAR.error):
    """A step with stages so close to a singular configuration, which half of it keeps as far away as it `gains`."""
    placement = Placement(*map(jnp.asarray, (passes, follows, 0.5, gains)))
    return StepError(errors, jnp.asarray(leaves), placement)


CONTROLLERS = [
    diffrax.PIDController(rtol=1e-8, atol=1e-8),
    diffrax.ClipStepSizeController(diffrax.PIDController(rtol=1e-8, atol=1e-8), jump_ts=np.array([0.7])),
]


def adapt(controller, error, t0=0.0, t1=1.0, retries=0):
    control = MechanismControl(controller)
    t0, t1 = jnp.asarray(t0), jnp.asarray(t1)
    _, state = control.init(None, t0, 10.0 * t1, Y, jnp.asarray(0.1), ARGS, None, 8.0)
    state = state._replace(retries=jnp.asarray(retries))
    return control.adapt_step_size(t0, t1, Y, Y, ARGS, error, 8.0, state)


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("step", [near(1e-3), near(follows=1e-3)], ids=["its own", "of the next step"])
def test_a_stage_close_to_a_singular_configuration_is_moved_away(controller, step):
    keep, next_t0, next_t1, _, (_, retries, *_), _ = adapt(controller, step)
    assert not keep
    assert (next_t0, next_t1, retries) == (0.0, 0.5, 1)


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_an_error_from_such_a_stage_does_not_choose_the_next_try(controller):
    """It is rounding, however short the step: steps cut by it would crawl into the singular configuration."""
    errors = jnp.array([1e-4, 0.0]), jnp.zeros(2)
    # A step that is not taken is not placed for the next one.
    assert adapt(controller, FAR._replace(error=errors))[2] < 0.5
    assert adapt(controller, near(follows=1e-3, errors=errors))[2] < 0.5
    keep, next_t0, next_t1, _, (_, retries, *_), _ = adapt(controller, near(1e-3, errors=errors))
    assert not keep
    assert (next_t0, next_t1, retries) == (0.0, 0.5, 1)


@pytest.mark.parametrize(
    "error",
    [
        FAR,
        near(0.02),
        near(1e-6, gains=0.0, leaves=0.0),
        near(1e-3, gains=1.5e-3, leaves=5e-3),
    ],
    ids=["far", "far enough", "from a singular configuration", "as far as a step from so close can keep"],
)
def test_other_steps_are_kept(error):
    keep, next_t0, next_t1, *_ = adapt(CONTROLLERS[0], error)
    assert keep
    assert next_t0 == 1.0
    assert next_t1 > 2.0


def test_it_gives_up_after_some_tries():
    tried = [bool(adapt(CONTROLLERS[0], near(1e-3), retries=retries)[0]) for retries in range(8)]
    assert tried == sorted(tried)
    assert not tried[0]
    assert tried[-1]


def test_fixed_steps_are_left_alone():
    close, far = (adapt(diffrax.ConstantStepSize(), near(d)) for d in (1e-3, 1.0))
    assert close[0]
    assert close[:3] == far[:3]


def test_errors_count_in_the_units_of_the_mechanism_less_rounding():
    at = lambda q, v: FAR._replace(error=(jnp.asarray(q), jnp.asarray(v)))
    kept = lambda error: bool(adapt(CONTROLLERS[0], error)[0])
    # Of two coordinates and two speeds: the root of the mean square counts.
    assert kept(at([1.5e-8, 0.0], [0.0, 0.0]))
    assert kept(at([0.0, 1.5e-5], [0.0, 0.0]))
    assert not kept(at([6e-8, 0.0], [0.0, 0.0]))
    assert not kept(at([0.0, 6e-5], [0.0, 0.0]))
    # The tightest of tolerances does not ask for less than rounding.
    tight = diffrax.PIDController(rtol=1e-30, atol=1e-30)
    assert bool(adapt(tight, at([2e-16, 2e-13], [8e-16, 8e-13]))[0])
    assert not bool(adapt(tight, at([1e-14, 0.0], [0.0, 0.0]))[0])


def test_rounding_in_an_estimate_does_not_choose_the_next_step():
    def next_step(size):
        _, _, end, *_ = adapt(CONTROLLERS[0], FAR._replace(error=(jnp.array([size, 0.0]), jnp.zeros(2))))
        return float(end)

    assert next_step(1e-14) == next_step(3e-14) > next_step(1e-11)


def test_rounding_grows_near_a_singular_configuration_like_its_square():
    """Where no placement keeps a step away; and not from a singular configuration, where such rows are none."""
    tight, turn, eps = diffrax.PIDController(rtol=1e-30, atol=1e-30), 4.0, np.finfo(float).eps

    def kept(size, **step):
        return bool(adapt(tight, near(errors=(jnp.array([size, 0.0]), jnp.zeros(2)), **step), retries=4)[0])

    for d, least in ((1e-2, 1e-2), (1e-4, 1e-4), (1e-9, 1e-6)):
        rounding = eps * (1.0 / least + AMPLIFIED * turn / least**2)
        for step in ({"passes": d, "gains": 0.0}, {"leaves": max(d, 1e-6), "gains": 0.0}):
            assert kept(0.99 * rounding, **step)
            assert not kept(1.01 * rounding, **step)
    others = (1e-4, {"passes": 1e-4, "gains": 1e-2}), (1e-6, {"passes": 1e-2, "gains": 0.0, "leaves": 0.0})
    for d, step in others:
        rounding = eps * (1.0 / d + AMPLIFIED * turn / 1e-2**2)
        assert kept(0.99 * rounding, **step)
        assert not kept(1.01 * rounding, **step)


def test_from_a_state_that_is_not_sound_no_step_is_taken(monkeypatch):
    for controller in (CONTROLLERS[0], diffrax.ConstantStepSize()):
        *_, result = adapt(controller, FAR)
        assert result == diffrax.RESULTS.successful
        monkeypatch.setattr(ARGS, "can_go_on", lambda t, y: False)
        keep, *_, result = adapt(controller, FAR)
        assert not keep
        assert result == diffrax.RESULTS.dt_min_reached
        monkeypatch.undo()


def test_under_jit_vmap_and_both_modes():
    def next_step(size, passes):
        keep, _, next_t1, *_ = adapt(CONTROLLERS[0], near(passes, errors=(size * jnp.ones(2), jnp.zeros(2))))
        return jnp.where(keep, next_t1, -next_t1)

    sizes, passes = jnp.array([1e-9, 1e-9, 1e-7]), jnp.array([0.5, 1e-3, 0.5])
    alone = jax.jit(next_step)
    single = [alone(size, near) for size, near in zip(sizes, passes, strict=True)]
    np.testing.assert_allclose(jax.jit(jax.vmap(next_step))(sizes, passes), single, rtol=1e-14)
    for mode in (jax.jacfwd, jax.jacrev):
        assert np.isfinite(jax.jit(mode(next_step))(1e-9, jnp.asarray(0.5)))


@pytest.mark.parametrize("solver", [diffrax.Tsit5(), diffrax.Dopri5(), diffrax.Dopri8(), diffrax.Kvaerno5()])
def test_a_passage_anywhere_falls_between_stages_of_this_step_or_the_next(solver):
    """Of a distance that falls and rises like |t − t*|: told is what a step that is cut, and the next, come to."""
    nodes, rate = np.unique(np.asarray(solver.tableau.c, dtype=float)), 0.1
    distances = lambda ends, place: rate * np.abs(np.asarray(ends) - place)
    of = jax.jit(lambda place: Placement.of(nodes, *(rate * jnp.abs(ends - place) for ends in (0.0, nodes, 1.0))))
    for place in np.linspace(0.03, 2.5, 60):
        found = of(place)
        np.testing.assert_allclose(found.passes, np.min(distances(nodes, place)), rtol=1e-12)
        cut = float(found.retry)
        assert 0.0 < cut < 1.0 or not float(found.gains)
        following = cut + min(GROWTH * cut, 1.0) * nodes
        reached = np.min(distances([*(cut * nodes), *following], place))
        assert reached >= 0.999 * float(found.gains)
        # Close is only what begins close, or a stage after the end of a step.
        if place < 1.0 or nodes[-1] == 1.0:
            assert max(min(found.passes, found.follows), found.gains) >= 0.1 * rate * min(place, 0.2), place
    for leaves, arrives in ((0.0, 0.1), (0.05, 0.1)):  # from a singular configuration, and away from one
        still = Placement.of(nodes, jnp.asarray(leaves), leaves + (arrives - leaves) * nodes, jnp.asarray(arrives))
        assert float(still.gains) == 0.0


@pytest.mark.parametrize("rtol", [1e-4, 1e-8])
def test_implicit_steps_go_on_while_they_converge(rtol):
    """Steps are as long as their errors allow, though their equations take more than two iterations."""
    state, accuracy = lx.State(jnp.array([0.3]), jnp.zeros(1)), lx.Accuracy(rtol=rtol)
    stats = lx.simulate(pendulum(), state, t1=5.0, solver=diffrax.Kvaerno5(), accuracy=accuracy).stats
    assert stats["num_rejected_steps"] < stats["num_accepted_steps"] / 4


@pytest.mark.slow
def test_derivatives_over_steps_whose_equations_have_no_solution():
    """The first step, of the whole time, and some after it fail, and are tried again, shorter."""
    scene = SCENES["crank-slider"]
    settings = scene.settings("SC1", {})
    start, accuracy = scene.initial(scene.mechanism(settings), settings), lx.Accuracy(1e-7)
    options = {"solver": diffrax.Kvaerno5(), "accuracy": accuracy, "dt0": 2.0, "saveat": diffrax.SaveAt(t1=True)}

    @jax.jit
    @partial(jax.value_and_grad, has_aux=True)
    def run(mass):
        mechanism = scene.mechanism(scene.settings("SC1", {"slider_mass": mass}))
        solution = lx.simulate(mechanism, start, t1=2.0, **options)
        return solution.end.q[0], solution.stats["num_rejected_steps"]

    (_, rejected), slope = run(1.0)
    step = 1e-3
    ends = [run(1.0 + change)[0][0] for change in (step, -step)]
    assert rejected > 5
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / (2.0 * step), rtol=1e-4)


@pytest.mark.parametrize(("tolerance", "ends"), [(1e-2, True), (1e-4, False)])
def test_iterations_end_where_rounding_within_the_tolerance_is_left(tolerance, ends):
    """Of an equation that leaves 1e-3, more than the share of the tolerance that the iterations are to come down to."""
    noisy = lambda y, _: y - 1.0 + 1e-3 * jnp.sign(y - 1.0)
    found = optx.root_find(noisy, Chord(0.0, tolerance), jnp.asarray(1.001), max_steps=30, throw=False)
    assert (found.result == optx.RESULTS.successful) == ends
    assert found.stats["num_steps"] <= 10 or not ends


REST = lx.State(jnp.zeros(1), jnp.zeros(1))


def held_weight(stiffness, damping):
    """A weight on a slide, held by a spring and a damper."""
    weight = lx.point_mass("weight", 1.0)
    slide = lx.Prismatic("slide", lx.GROUND, weight, axis="y")
    forces = [lx.Gravity([0.0, -9.81, 0.0]), lx.JointSpring("slide", stiffness), lx.JointDamper("slide", damping)]
    return lx.Mechanism([weight], [slide], forces)


@pytest.mark.parametrize(
    ("stiffness", "damping", "duration", "named"),
    [(1e8, 0.0, 0.5, "JointSpring"), (0.0, 1e4, 0.5, "JointDamper"), (1e2, 0.0, 200.0, None)],
)
def test_an_element_that_chooses_the_steps_is_named(stiffness, damping, duration, named):
    """By its rate, √(k / m) or c / m, and not where the motion chooses them, however long it takes."""
    mechanism, match = held_weight(stiffness, damping), rf"{named}.*'slide'.* 1\.0e\+04 1/s"
    with nullcontext() if named is None else pytest.warns(lx.StiffnessWarning, match=match):
        lx.simulate(mechanism, REST, t1=duration, max_steps=4096)


@pytest.mark.parametrize(
    ("damping", "advised"),
    [
        # A wave that rings until the end: implicit steps have to follow it, too.
        (1e2, {diffrax.Dopri8: "take a rigid joint", lx.Rodas5P: r"Dopri8\(\) takes about as many"}),
        # One that comes to rest at once: these are 111, and 1462 of an explicit solver.
        (2e3, {diffrax.Dopri8: r"take solver=linkax.Rodas5P\(\)", lx.Rodas5P: None}),
    ],
)
def test_of_two_solvers_at_most_one_advises_the_other(damping, advised):
    mechanism = held_weight(1e8, damping)
    for solver, advice in advised.items():
        with nullcontext() if advice is None else pytest.warns(lx.StiffnessWarning, match=advice):
            lx.simulate(mechanism, REST, t1=0.5, solver=solver(), max_steps=4096)


def test_a_run_that_an_element_keeps_from_its_end_names_it():
    mechanism = held_weight(1e12, 0.0)
    with pytest.raises(lx.SimulationError, match=r"maximum number of solver steps.*JointSpring.* 1\.0e\+06 1/s"):
        lx.simulate(mechanism, REST, t1=2.0, max_steps=4096)
