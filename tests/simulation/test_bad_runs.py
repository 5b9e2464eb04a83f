"""Bad states and options are refused before anything is compiled; bad numbers in a run are told, and harm no other."""

import functools
from dataclasses import replace

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mechanisms import crank_slider, pendulum
from plans import FEW
from refusals import Shown, refused

import linkax as lx
from linkax.simulation.integrate.run import Run, checked_formulation
from linkax.simulation.start.validation import sound_numbers
from scalarjit.program import Scalarised

MECHANISM = crank_slider()
N_Q, N_V = MECHANISM.topology.num_coordinates, MECHANISM.topology.num_speeds
STATE = lx.State(jnp.zeros(N_Q), jnp.zeros(N_V))
FIRST = next(iter(MECHANISM.topology.coordinates))
ONE, ARM = pendulum(forces=[lx.JointDamper("hinge", 0.1)]), lx.rod("arm", 1.0, 1.0)
AT_REST = lx.State(jnp.zeros(1), jnp.zeros(1))


@pytest.fixture
def _nothing_compiled(monkeypatch):
    """What is refused is so before a program is made."""

    def never(*arguments):
        pytest.fail("refused only after a program was made")

    monkeypatch.setattr(Scalarised, "__call__", never)
    monkeypatch.setattr(Scalarised, "lower", never)


NO_NUMBER = [np.nan, np.inf, None, "long", "1.0", 1.0j, True, [1.0, 2.0], jnp.asarray([1.0]), jnp.asarray(np.nan), {}]
SUBS = diffrax.SubSaveAt
OPTIONS = {
    "t1": [*NO_NUMBER, 0.0, -1.0],
    "t0": [*NO_NUMBER, 2.0, 3.0],
    "dt0": [*(entry for entry in NO_NUMBER if entry is not None), 0.0, -0.1],
    "accuracy": [None, 1e-8, "high", lx.Accuracy],
    "formulation": ["magic", "", "lagrange-multipliers+", 3, lx.LagrangeMultipliers(), lx.ClassicalFormulation],
    "saveat": [[0.0, 1.0], 3.0, "steps", diffrax.SaveAt, SUBS(t1=True)],
    "solver": [
        "dopri8", 3, diffrax.Dopri8, diffrax.ODETerm, diffrax.SemiImplicitEuler(), diffrax.EulerHeun(),
        diffrax.ItoMilstein(), diffrax.Euler(), lx.RungeKutta4(), diffrax.LeapfrogMidpoint(),
    ],
    "stepsize_controller": [
        1e-3, "pid", diffrax.PIDController, diffrax.ConstantStepSize(), diffrax.PIDController(rtol=-1e-3, atol=1e-8),
        diffrax.PIDController(rtol=1e-3, atol=np.nan), diffrax.PIDController(rtol="fine", atol=1e-8),
        diffrax.PIDController(rtol=jnp.asarray(np.inf), atol=1e-8), diffrax.PIDController(rtol=1e308, atol=1e-8),
    ],
    "max_steps": [0, -5, 1.5, "many", True, np.nan, 10**400],
    "optimise": ["no", 1.0, jnp.ones(3)],
    "throw": ["no", None, 1.0, jnp.ones(3)],
    "adjoint": ["reverse", 3, diffrax.ForwardMode, diffrax.BacksolveAdjoint()],
    "event": [3, lambda t, state, mechanism: t > 1.0, diffrax.Event],
    "progress_meter": ["bar", True, diffrax.TextProgressMeter],
    "dtype": ["banana", int, complex, jnp.float16, 3, object, jnp.ones(2), np.float64(1.0)],
}  # fmt: skip
UNNAMED_VALUES = ("saveat", "solver", "stepsize_controller", "event", "dtype", "adjoint", "progress_meter")
CASES = [(name, index) for name, values in OPTIONS.items() for index in range(len(values))]


@pytest.mark.parametrize(("name", "index"), CASES)
@pytest.mark.usefixtures("_nothing_compiled")
def test_bad_options_are_named(name, index):
    value = OPTIONS[name][index]
    words = (name,) if name in UNNAMED_VALUES else (name, Shown(value))
    refused(lambda: lx.simulate(MECHANISM, STATE, **{"t1": 2.0, name: value}), *words)


times = st.lists(st.floats(0.0, 2.0), min_size=1, max_size=4).map(sorted)
BAD_TIMES = {
    "unsorted": lambda ts: [*ts, ts[0] - 0.5] if ts[0] > 0.5 else [ts[-1] + 0.1, *ts],
    "before the start": lambda ts: [-0.1, *ts],
    "after the end": lambda ts: [*ts, 2.1],
    "not a number": lambda ts: [*ts, np.nan],
    "infinite": lambda ts: [*ts, np.inf],
    "of two dimensions": lambda ts: [ts],
    "complex": lambda ts: np.array(ts) + 0j,
    "booleans": lambda ts: [False, True],
}


@pytest.mark.parametrize("case", BAD_TIMES)
@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.usefixtures("_nothing_compiled")
def test_bad_saved_times_are_named(case, nested):
    @FEW
    @given(ts=times)
    def check(ts):
        ts = jnp.asarray(BAD_TIMES[case](ts))
        saveat = diffrax.SaveAt(subs={"late": SUBS(t1=True), "some": SUBS(ts=ts)}) if nested else diffrax.SaveAt(ts=ts)
        refused(lambda: lx.simulate(MECHANISM, STATE, t1=2.0, saveat=saveat), "saveat")

    check()


@pytest.mark.parametrize("saveat", [diffrax.SaveAt(dense=True), diffrax.SaveAt(steps=True)], ids=["dense", "steps"])
@pytest.mark.usefixtures("_nothing_compiled")
def test_steps_without_a_largest_number_are_named(saveat):
    refused(lambda: lx.simulate(MECHANISM, STATE, t1=1.0, saveat=saveat, max_steps=None), "max_steps", "saveat")


def test_an_unknown_option_is_named():
    with pytest.raises(TypeError, match="tolerance"):
        lx.simulate(MECHANISM, STATE, t1=1.0, tolerance=1e-3)


ACCURACY = {
    "rtol": [0.0, -1e-8, 2.0, 1e308, *NO_NUMBER[:8]],
    "atol": [0.0, -1e-8, 1e308, np.nan, "fine", True],
    "clearance": [-1e-2, np.nan, "far", True],
    "projection": ["always", None, True],
    "metric": ["euclid"],
}
TANGENT_SPACE = {
    "rank_tolerance": [0.0, -1.0, np.inf, "fine"],
    "metric": ["euclid", 3, None],
    "corrections": [0, -1, 1.5, None],
}


@pytest.mark.parametrize("name", ACCURACY)
def test_bad_accuracies_are_named(name):
    for value in ACCURACY[name]:
        if not (name == "atol" and value is None):
            refused(lambda value=value: lx.Accuracy(**{name: value}), name, Shown(value))


@pytest.mark.parametrize("name", TANGENT_SPACE)
def test_bad_numbers_of_the_tangent_space_are_named(name):
    for value in TANGENT_SPACE[name]:
        refused(lambda value=value: lx.TangentSpace(**{name: value}), name, Shown(value))


def test_numbers_of_the_tangent_space_in_an_accuracy_hold_and_warn():
    with pytest.warns(DeprecationWarning, match="give formulation=linkax.TangentSpace"):
        accuracy = lx.Accuracy(1e-6, metric="identity", rank_tolerance=1e-5)
    run = Run.of_state(MECHANISM, STATE, 0.0, checked_formulation("tangent-space", accuracy), accuracy)
    assert run.tangent_space.metric == "identity"
    assert run.tangent_space.rank_tolerance == 1e-5
    with pytest.raises(ValueError, match=r"give them to linkax\.TangentSpace alone"):
        lx.simulate(MECHANISM, STATE, t1=1.0, accuracy=accuracy, formulation=lx.TangentSpace())


def test_numbers_are_replaced():
    assert replace(lx.BALANCED, rtol=1e-6).rtol == 1e-6
    assert replace(lx.TangentSpace(1e-5), metric="identity").rank_tolerance == 1e-5


READERS = {
    "simulate": functools.partial(lx.simulate, t1=1.0),
    "mobility": lx.mobility,
    "inverse_dynamics": lambda mechanism, state, **t: lx.inverse_dynamics(mechanism, state, {FIRST: 1.0}, **t),
    "equilibrium": lx.equilibrium,
    "linearise": lx.linearise,
    "of_state": lx.Solution.of_state,
}
STATES = {
    "none": (lambda: None, "assemble"),
    "a dictionary": (lambda: {FIRST: 0.1}, "assemble"),
    "an array": (lambda: jnp.zeros(N_Q), "assemble"),
    "the class": (lambda: lx.State, "assemble"),
    "too few coordinates": (lambda: lx.State(jnp.zeros(N_Q - 1), jnp.zeros(N_V)), "state.q"),
    "too many speeds": (lambda: lx.State(jnp.zeros(N_Q), jnp.zeros(N_V + 2)), "state.v"),
    "a batch": (lambda: lx.State(jnp.zeros((2, N_Q)), jnp.zeros((2, N_V))), "state.q"),
    "a coordinate that is not a number": (lambda: lx.State(STATE.q.at[0].set(np.nan), STATE.v), f"'{FIRST}'"),
    "a speed that is infinite": (lambda: lx.State(STATE.q, STATE.v.at[0].set(-np.inf)), f"'{FIRST}'"),
    "complex coordinates": (lambda: lx.State(STATE.q + 0j, STATE.v), "state.q"),
    "speeds as text": (lambda: lx.State(STATE.q, N_V * ["fast"]), "state.v"),
    "no speeds": (lambda: lx.State(STATE.q, None), "state.v"),
    "booleans": (lambda: lx.State(STATE.q, STATE.v == 0.0), "state.v"),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("case", STATES)
def test_bad_states_are_named(reader, case):
    make, word = STATES[case]
    refused(lambda: READERS[reader](MECHANISM, make()), word)


@pytest.mark.parametrize("reader", [*READERS, "assemble"])
def test_single_precision_that_nobody_asked_for_is_named(reader):
    calls = READERS | {"assemble": lambda mechanism, state: lx.assemble(mechanism)}
    with jax.enable_x64(False):
        refused(lambda: calls[reader](MECHANISM, STATE), "jax_enable_x64")


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    "value", [None, "crank", crank_slider, lx.Mechanism, 3.0], ids=str.split("none text function class number")
)
def test_what_is_no_mechanism_is_named(reader, value):
    refused(lambda: READERS[reader](value, STATE), "mechanism", Shown(value))


@pytest.mark.parametrize("reader", sorted({*READERS} - {"simulate"}))
@pytest.mark.parametrize("value", NO_NUMBER, ids=repr)
def test_bad_times_of_a_state_are_named(reader, value):
    refused(lambda: READERS[reader](MECHANISM, STATE, t=value), "t [s]", Shown(value))


@pytest.mark.parametrize("what", ["positions", "speeds", "guess"])
@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([0.1], ["[0.1]"]),
        ("bearing", ["'bearing'"]),
        (3.0, ["3.0"]),
        ({"nip": 0.1}, ["'nip'", "'bearing'"]),
        ({3: 0.1}, ["3"]),
        ({None: 0.1}, ["None"]),
        ({("bearing", 1): 0.1}, ["'bearing'", "1"]),
        ({("bearing", "x"): 0.1}, ["'bearing'", "'x'"]),
        *(({"bearing": value}, ["'bearing'", Shown(value)]) for value in NO_NUMBER if np.shape(value) != (1,)),
        ({"bearing": [0.1, 0.2]}, ["'bearing'", "(2,)"]),
        ({"bearing": []}, ["'bearing'", "(0,)"]),
    ],
    ids=repr,
)
@pytest.mark.usefixtures("_nothing_compiled")
def test_bad_positions_and_speeds_are_named(what, given, words):
    refused(lambda: lx.assemble(MECHANISM, **{what: given}), *words)


@pytest.mark.parametrize("value", [entry for entry in NO_NUMBER if entry is not None], ids=repr)
@pytest.mark.usefixtures("_nothing_compiled")
def test_a_bad_time_of_assembly_is_named(value):
    refused(lambda: lx.assemble(MECHANISM, t=value), "t [s]", Shown(value))


@pytest.mark.parametrize("count", [-1, 1.5, "one", True, 2, 0])
def test_a_bad_number_of_degrees_of_freedom_is_named(count):
    refused(lambda: lx.linearise(ONE, AT_REST, degrees_of_freedom=count), "degrees_of_freedom", Shown(count))


def test_bodies_that_move_without_mass_are_named_where_there_is_no_run():
    link, tail = lx.rod("link", 1.0, 1.0), lx.rod("tail", 1.0, 0.0)
    pin = lx.Revolute("pin", lx.GROUND, link.at("base"), "z")
    mechanism = lx.Mechanism([link, tail], [pin, lx.Revolute("knee", link.at("tip"), tail.at("base"), "z")])
    state = lx.State(jnp.zeros(2), jnp.zeros(2))
    refused(lambda: lx.linearise(mechanism, state), "'tail'")
    refused(lambda: lx.inverse_dynamics(mechanism, state, {"pin": 1.0}), "'tail'")


def test_quaternions_that_are_no_rotation_are_named():
    body = lx.RigidBody("body", 1.0, inertia=(1.0, 1.0, 1.0))
    mechanism = lx.Mechanism([body], [lx.Spherical("ball", lx.GROUND, body)])
    for q in (np.zeros(4), 1e-200 * np.ones(4), 1e200 * np.ones(4)):
        refused(lambda q=q: lx.simulate(mechanism, lx.State(q, np.zeros(3)), t1=1.0), "'ball'", Shown(q))
        refused(lambda q=q: lx.assemble(mechanism, {"ball": q}), "'ball'", Shown(q))


def test_what_cannot_move_is_named():
    link = lx.rod("link", 1.0, 1.0)
    mechanism = lx.Mechanism([link], [lx.Fixed("weld", lx.GROUND, link)])
    refused(lambda: lx.assemble(mechanism), "'weld'")
    refused(lambda: lx.Mechanism([], []), "bodies", "[]")


OFF = {
    "position": (lambda q, v: (q.at[0].add(0.1), v), r"'\w+' is open by 0\.\d+, in radians or lengths"),
    "speed": (lambda q, v: (q, v.at[0].add(0.1)), r"they miss its speeds by 0\.0\d+ of the largest one"),
}


@pytest.mark.parametrize(("moved", "told"), OFF.values(), ids=OFF)
def test_a_state_off_the_loops_is_named_and_marked(moved, told):
    on = lx.assemble(MECHANISM, {"bearing": 0.5}, {"bearing": 2.0})
    off = lx.State(*moved(on.q, on.v))
    with pytest.raises(ValueError, match=f"state is off the loops: {told}.*linkax.assemble"):
        lx.Solution.of_state(MECHANISM, off)
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), lx.State(on.q, on.v), off)
    results = jax.vmap(lambda state: lx.Solution.of_state(MECHANISM, state).result)(both)
    assert (results == lx.RESULTS.not_closed).tolist() == [False, True]
    # Classical formulations may leave loops open, and pictures show them.
    lx.Solution.of_state(MECHANISM, off, formulation="lagrange-multipliers")
    MECHANISM.view(off)


def test_a_state_copied_from_seven_digits_is_read():
    on = lx.assemble(MECHANISM, {"bearing": 0.5}, {"bearing": 2.0})
    copied = lx.State(*(jnp.array([float(f"{number:.7g}") for number in array]) for array in (on.q, on.v)))
    np.testing.assert_allclose(lx.Solution.of_state(MECHANISM, copied).joint("bearing"), 0.5, rtol=1e-6)


def test_a_drive_that_is_not_finite_is_named():
    mechanism = pendulum(constraints=[lx.Drive("motor", "hinge", lambda t: jnp.sqrt(t - 2.0))])
    refused(lambda: lx.simulate(mechanism, AT_REST, t1=1.0), "'motor'", "not finite")


def test_a_batch_is_named():
    batch = jax.vmap(lambda damping: pendulum(forces=[lx.Damper(lx.GROUND, ARM, damping)]))(jnp.ones(3))
    batch = eqx.tree_at(lambda m: m.bodies[0].mass, batch, jnp.ones(3))
    refused(lambda: lx.simulate(batch, AT_REST, t1=1.0), "batch", "(3,)")


# Laws of forces are first called when a run is traced.


def _raises(t, motion):
    raise KeyError("a table without such an entry")


LAWS = {
    "nothing": lambda t, motion: None,
    "text": lambda t, motion: "strong",
    "two numbers": lambda t, motion: jnp.ones(2),
    "a complex number": lambda t, motion: jnp.asarray(1.0j),
    "of time alone": lambda t: 1.0,
    "raises": _raises,
    "branches": lambda t, motion: 1.0 if t > 1.0 else 0.0,
    "asks for an unknown joint": lambda t, motion: motion.joint("nip"),
}


@pytest.mark.parametrize("case", LAWS)
@pytest.mark.parametrize("kind", ["JointTorque", "PointForce"])
def test_bad_laws_are_named(case, kind):
    on, named = {"JointTorque": ("hinge", "'hinge'"), "PointForce": (ARM.at("tip"), "'arm'")}[kind]
    mechanism = pendulum(forces=[getattr(lx, kind)(on, LAWS[case])])
    refused(lambda: lx.simulate(mechanism, AT_REST, t1=1.0), kind, named)


class Bad(lx.AbstractForce):
    loads: object = eqx.field(static=True)

    def load(self, t, motion):
        return self.loads(motion)


LOADS = {
    "nothing": lambda motion: None,
    "a number": lambda motion: 1.0,
    "a part of it": lambda motion: lx.Load.none(motion.system)[:2],
    "of a wrong shape": lambda motion: lx.Load.none(motion.system)._replace(force=jnp.ones(2)),
    "complex": lambda motion: lx.Load.none(motion.system)._replace(joint_force=jnp.asarray([1.0j])),
}


@pytest.mark.parametrize("case", LOADS)
def test_bad_loads_are_named(case):
    mechanism = pendulum(forces=[Bad(LOADS[case])])
    refused(lambda: lx.simulate(mechanism, AT_REST, t1=1.0), "Bad")


# Numbers that are known only when a program runs: one program for all of them.


def _pushed(after, t, motion):
    start, push = after
    return jnp.where(t >= start, push, 0.0)


def _two_cranks(mass, length, start, push):
    """Two cranks and a massless rod between them: one crank's mass, the rod's length, a push from a time on."""
    crank, rocker = lx.rod("crank", 1.0, 1.0), lx.rod("rocker", 1.0, 1.0)
    crank = eqx.tree_at(lambda body: body.mass, crank, mass)
    joints = [
        lx.Revolute("bearing", lx.GROUND, crank.at("base"), axis="z"),
        lx.Revolute("pivot", lx.GROUND.at([0.5, 0.0, 0.0]), rocker.at("base"), axis="z"),
    ]
    law = jax.tree_util.Partial(_pushed, jnp.stack([jnp.asarray(start), jnp.asarray(push)]))
    forces = [lx.Gravity([0.0, -9.81, 0.0]), lx.JointTorque("bearing", law)]
    rod = lx.Distance("coupler", crank.at("tip"), rocker.at("tip"), length)
    return lx.Mechanism([crank, rocker], joints, forces, [rod])


TIMES = 5


@jax.jit
def _batch(mass, length, start, push, q, v, t1, ts):
    def member(mass, length, start, push, q, v, t1, ts):
        solution = lx.simulate(
            _two_cranks(mass, length, start, push),
            lx.State(q, v),
            t1=t1,
            saveat=diffrax.SaveAt(ts=ts),
            solver=diffrax.Bosh3(),
            accuracy=lx.DRAFT,
            max_steps=64,
        )
        return solution.ts, solution.q, solution.v, solution.result == lx.RESULTS.successful

    return jax.vmap(member)(mass, length, start, push, q, v, t1, ts)


GOOD = {"mass": 1.0, "length": 0.5, "start": 0.05, "push": 1.0, "t1": 0.1}
SPOILT = {
    "mass": [np.nan, np.inf, -np.inf, -1.0, -1e9, 0.0, 1e308],
    "length": [np.nan, np.inf, 0.0, 9.0, 1e300],
    "start": [np.nan],
    "push": [np.nan, np.inf, -np.inf, 1e300],
    "t1": [np.nan, np.inf, -np.inf, -1.0, 0.0, 1e-320, 1e300],
    "ts": [np.nan, np.inf, -0.1, 0.2],
    "q": [np.nan, np.inf, 5.0, 1e300],
    "v": [np.nan, np.inf, 1e300, 1e9],
}
SIZE = 6


def _members(spoilt):
    """A batch of members of unlike masses, the first of them spoilt, by (name, value)."""
    batch = {name: np.full(SIZE, value) for name, value in GOOD.items()}
    batch |= {"q": np.ones((SIZE, 2)), "v": np.ones((SIZE, 2)), "ts": np.tile(np.linspace(0.0, 0.1, TIMES), (SIZE, 1))}
    batch["mass"] = np.linspace(0.8, 1.2, SIZE)
    for member, (name, value) in enumerate(spoilt):
        part = batch[name][member : member + 1]
        part[..., -1] = value
        if name == "t1" and value > 0.0:
            batch["ts"][member] *= 0.0  # within the run
    return [np.asarray(part) for part in _batch(**batch)]


@FEW
@given(order=st.permutations([(name, value) for name, values in SPOILT.items() for value in values]))
def test_a_bad_member_is_marked_and_harms_no_other(order):
    right = _members([])
    assert np.all(right[-1])
    for begin in range(0, len(order), 4):
        spoilt = order[begin : begin + 4]
        *found, successful = _members(spoilt)
        others = slice(len(spoilt), None)
        assert np.all(successful[others])
        for whole, of_right in zip(found, right, strict=False):
            np.testing.assert_allclose(whole[others], of_right[others], rtol=1e-12, atol=1e-15)
        for member, (name, value) in enumerate(spoilt):
            finite = all(np.all(np.isfinite(part[member])) for part in found)
            assert finite or not successful[member], (name, value)
            impossible = (name == "mass" and value < 0.0) or (name != "start" and not np.isfinite(value))
            assert not (impossible and successful[member]), (name, value)


# Numbers of a mechanism that a run does not need to be finite, or that it would run with all the same.
POSSIBLE = {
    "mass": 1.0, "length": 1.0, "moment": 1.0, "turn": 1.0, "unused": 1.0, "torque": 0.1, "scale": 1.0, "rest": 0.5,
    "slack": 1.0,
}  # fmt: skip
IMPOSSIBLE = {
    "mass": -0.1, "length": -1.0, "moment": 5.0, "turn": 2.0, "unused": np.inf, "torque": -1.0, "scale": -0.5,
    "rest": -1.0, "slack": -3.0,
}  # fmt: skip


def _of_numbers(mass, length, moment, turn, unused, torque, scale, rest, slack):
    """A pendulum of two bodies, with a rope that stays slack."""
    link = lx.RigidBody("link", mass, inertia=jnp.diag(jnp.stack([1.0, 1.0, moment])), frames={"tip": 3 * [unused]})
    bar = lx.rod("bar", length, 1.0)
    joints = [
        lx.Revolute("pin", lx.GROUND, link.at([-0.5, 0.0, 0.0], turn * jnp.eye(3)), "z"),
        lx.Fixed("weld", link, bar.at("base")),
    ]
    forces = [
        lx.Gravity([0.0, -9.81, 0.0]),
        lx.JointFriction("pin", torque, scale),
        lx.Spring(lx.GROUND.at([0.0, 2.0, 0.0]), link, 1.0, rest),
        lx.ElasticRope([lx.GROUND, link], slack, 9.0),
    ]
    return lx.Mechanism([link, bar], joints, forces)


@jax.jit
@jax.vmap
def _readings(numbers):
    """Of each member: states, whether its run and its state are right, what else was found, all of it finite or not."""
    mechanism, ts = _of_numbers(**numbers), jnp.linspace(0.0, 0.1, TIMES)
    assembled = lx.assemble(mechanism, {"pin": 0.3}, {"pin": 0.1})
    run = lx.simulate(
        mechanism, assembled, t1=0.1, saveat=diffrax.SaveAt(ts=ts), solver=diffrax.Bosh3(), accuracy=lx.DRAFT
    )
    state = lx.State(jnp.full(1, 0.3), jnp.zeros(1))
    results = [run.result, lx.Solution.of_state(mechanism, state).result]
    rest = lx.equilibrium(mechanism, state)
    found = [
        assembled.v,
        lx.mobility(mechanism, state).distance,
        rest.q,
        lx.linearise(mechanism, rest, degrees_of_freedom=1).natural_frequencies,
        lx.inverse_dynamics(mechanism, state, {"pin": 1.0}).acceleration,
    ]
    of = lambda kind: jnp.stack([result == kind for result in results])
    finite = jnp.stack([jnp.all(jnp.isfinite(part)) for part in found])
    return run.q, run.v, *found, of(lx.RESULTS.successful), of(lx.RESULTS.not_finite), finite


@pytest.mark.slow
def test_a_member_with_numbers_that_cannot_be_is_marked_and_changes_no_other():
    count = len(POSSIBLE) + 2
    right = {name: np.full(count, value) for name, value in POSSIBLE.items()}
    wrong = {
        name: np.where(np.arange(count) == place, IMPOSSIBLE[name], right[name]) for place, name in enumerate(right)
    }
    *numbers, successful, _, finite = map(np.asarray, _readings(right))
    assert np.all(successful)
    assert np.all(finite)
    *found, successful, not_finite, finite = map(np.asarray, _readings(wrong))
    spoilt = np.arange(count) < len(POSSIBLE)
    for told in (not_finite, ~successful, ~finite):
        np.testing.assert_array_equal(told, np.broadcast_to(spoilt[:, None], told.shape))
    for whole, expected in zip(found, numbers, strict=True):
        np.testing.assert_array_equal(whole[~spoilt], expected[~spoilt])


class Wall(lx.AbstractForce):
    limit: jax.Array

    def load(self, t, motion):
        return lx.Load.none(motion.system)


def test_numbers_of_a_users_own_may_be_what_they_are():
    first = lambda rows, t, motion: rows[0]
    made = {
        "a force": lambda limit: Wall(limit),
        "a function": lambda limit: lx.JointTorque("hinge", jax.tree_util.Partial(first, jnp.stack([1.0, limit]))),
    }
    for force in made.values():
        assert jax.jit(lambda limit, force=force: sound_numbers(pendulum(forces=[force(limit)])))(jnp.nan)


def test_what_was_marked_is_told_outside_of_transformations_too():
    marked = jax.vmap(lambda slack: _of_numbers(**POSSIBLE | {"slack": slack}))(jnp.array([1.0, -3.0]))
    right, wrong = (jax.tree.map(lambda leaf, member=member: leaf[member], marked) for member in (0, 1))
    results = [lx.Solution.of_state(mechanism, AT_REST).result for mechanism in (right, wrong)]
    assert [bool(result == lx.RESULTS.not_finite) for result in results] == [False, True]
