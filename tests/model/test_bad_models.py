"""Any mechanism with any one thing wrong is refused when it is built, by an error that names it; a right one is not."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plans import BAD, FEW, SOME, Body, Part, plans
from refusals import Shown, refused

import linkax as lx
from linkax.equations.system import system_of

UNSHOWN = ("law", "frames", "coefficients")  # functions and dictionaries have no short name


@SOME
@given(plan=plans(), data=st.data())
def test_one_bad_argument_is_named(plan, data):
    """One argument of each sort that the mechanism has, with every value that this sort cannot have."""
    by_sort = {}
    for path, sort, named in plan.slots():
        by_sort.setdefault(sort, []).append((path, named))
    for sort, slots in by_sort.items():
        path, named = data.draw(st.sampled_from(slots))
        for value in BAD[sort]:
            words = () if path[-1] == "name" else named
            words = words if sort in UNSHOWN else (*words, Shown(value))
            refused(plan.with_bad(path, value).build, *words)


def _rod(name):
    return Part(lx.rod, (name,), {"name": name, "length": 1.0, "mass": 1.0}, {})


def _with(plan, **parts):
    """The plan with a part more in each of some places."""
    return dataclasses.replace(plan, **{place: (*getattr(plan, place), part) for place, part in parts.items()})


def _joint(kind, name, parent, child, place="joints", **more):
    ends = {"parent": Body(parent), "child": child if isinstance(child, Part) else Body(child)}
    return {place: Part(kind, (name,), {"name": name, **ends, **more}, {})}


def _force(kind, **arguments):
    return {"forces": Part(kind, (kind.__name__,), arguments, {})}


def _constraint(kind, name, **arguments):
    return {"constraints": Part(kind, (name,), {"name": name, **arguments}, {})}


LOOSE = {"bodies": _rod("loose")}
# What is wrong between elements that are right by themselves: parts that do not fit to a plan with a rod that is welded
# to its first body, and what the error must name.
STRUCTURES = {
    "two bodies of one name": ({"bodies": _rod("body_0")}, ["'body_0'", "2 times", "of its own"]),
    "two joints of one name": (_joint(lx.Fixed, "weld", None, "rod"), ["'weld'", "2 times", "of its own"]),
    "a constraint named like a joint": (
        _joint(lx.Distance, "pin", None, "body_0", "constraints", length=1.0),
        ["'pin'", "2 times", "of its own"],
    ),
    "a joint to a body that is not there": (
        _joint(lx.Fixed, "hook", None, _rod("loose")),
        ["'hook'", "'loose'", "add it"],
    ),
    "a body that hangs on nothing": (LOOSE, ["'loose'", "ground", "join"]),
    "a joint of a body with itself": (_joint(lx.Spherical, "knot", "rod", "rod"), ["'knot'", "'rod'", "two bodies"]),
    "a cut joint that closes no loop": (
        LOOSE | _joint(lx.Spherical, "end", "body_0", "loose", cut=True),
        ["'end'", "cut=True", "remove"],
    ),
    "a distance that carries a body": (
        LOOSE | _joint(lx.Distance, "tie", None, "loose", "constraints", length=1.0),
        ["'loose'", "ground"],
    ),
    "a force along an unknown joint": (
        _force(lx.JointTorque, joint="nip", torque=1.0),
        ["JointTorque", "'nip'", "'pin'"],
    ),
    "a speed that a joint lacks": (
        _force(lx.JointDamper, joint=("pin", 1), damping=1.0),
        ["JointDamper", "'pin'", "speed 1", "has 1"],
    ),
    "a force along a weld": (
        _force(lx.JointTorque, joint="weld", torque=1.0),
        ["JointTorque", "'weld'", "0 speeds", "not one"],
    ),
    "a force on a body that is not there": (
        _force(lx.PointForce, point=_rod("loose"), force=[1.0, 0.0, 0.0]),
        ["PointForce", "'loose'"],
    ),
    "a coupling with an unknown joint": (
        _constraint(lx.Coupling, "gears", coefficients={"pin": 1.0, "nip": 2.0}),
        ["'gears'", "'nip'", "'pin'"],
    ),
    "a drive of a weld": (_constraint(lx.Drive, "motor", joint="weld", motion=jnp.sin), ["'motor'", "'weld'"]),
}


@pytest.mark.parametrize("case", STRUCTURES)
@FEW
@given(plan=plans())
def test_elements_that_do_not_fit_are_named(case, plan):
    parts, words = STRUCTURES[case]
    welded = _with(plan, bodies=_rod("rod"), **_joint(lx.Fixed, "weld", "body_0", "rod"))
    refused(_with(welded, **parts).build, *words)


NO_ELEMENTS = [
    None, 3, np.array("s"), jnp.ones(()), "bodies", {"a": 1}, [None], ["part"], [lx.RigidBody], [lx.GROUND], [[]],
    print, [3.0],
]  # fmt: skip
# Where elements are given, and one that each remedy names.
PLACES = {"bodies": "RigidBody", "joints": "Revolute", "forces": "Gravity", "constraints": "Coupling"}


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("entry", NO_ELEMENTS, ids=repr)
def test_what_is_no_element_is_named(place, entry):
    link = lx.rod("link", 1.0, 1.0)
    elements = {"bodies": [link], "joints": [lx.Revolute("pin", lx.GROUND, link, "z")]}
    first = next(iter(entry)) if isinstance(entry, list | dict | str) else entry
    refused(lambda: lx.Mechanism(**elements | {place: entry}), place, repr(first), PLACES[place])


@pytest.mark.parametrize("place", PLACES)
def test_one_element_in_place_of_a_list_is_named(place):
    link = lx.rod("link", 1.0, 1.0)
    elements = {"bodies": link, "joints": lx.Revolute("pin", lx.GROUND, link, "z")}
    one = elements | {"forces": lx.Gravity([0.0, 0.0, -9.81]), "constraints": lx.Drive("motor", "pin", jnp.sin)}
    given = {name: [element] for name, element in elements.items()} | {place: one[place]}
    refused(lambda: lx.Mechanism(**given), f"{place} is one element", "list")


def test_an_element_in_the_wrong_list_is_named_with_the_right_one():
    link = lx.rod("link", 1.0, 1.0)
    pin, drive = lx.Revolute("pin", lx.GROUND, link, "z"), lx.Drive("drive", "pin", speed=1.0)
    spring, gears = lx.Spring(lx.GROUND, link.at("tip"), 1.0, name="strut"), lx.Coupling("gears", {"pin": 1.0})
    rod = lx.Distance("stay", lx.GROUND, link.at("tip"), 1.0)
    elements = {"bodies": [link], "joints": [pin]}
    right = {"RigidBody 'link'": link, "Revolute 'pin'": pin, "Spring 'strut'": spring, "coupling 'gears'": gears}
    homes = dict(zip(right, PLACES, strict=True))
    for name, element in right.items():
        for place in PLACES:
            if place != homes[name]:
                build = lambda place=place, element=element: lx.Mechanism(**elements | {place: [element]})
                refused(build, f"{name} belongs in {homes[name]}=[...]; take it out of {place}")
    refused(lambda: lx.Mechanism([link], [pin], [drive]), "drive 'drive' belongs in constraints=[...]")
    refused(lambda: lx.Mechanism([link], [pin], [rod]), "Distance 'stay' belongs in constraints=[...]")


def test_second_axes_that_are_known_are_checked_whatever_they_are():
    along, aside = [1.0, 0.0, 0.0], [1.0, 1.0, 0.0]
    for axis, second in ((along, aside), (along, jnp.array(aside)), (jnp.array(along), aside)):
        link = lx.rod("link", 1.0, 1.0)
        build = lambda a=axis, b=second, link=link: lx.Universal("cross", lx.GROUND, link, a, second_axis=b)
        refused(build, "'cross'", "second_axis", "45 degrees", "right angle")


@FEW
@given(plan=plans())
def test_a_right_mechanism_is_not_refused(plan):
    """And has equations of motion, as far as can be seen without numbers: those of the laws are in tests/equations."""
    mechanism = plan.build()
    topology = mechanism.topology
    state = lx.State(jnp.zeros(topology.num_coordinates), jnp.zeros(topology.num_speeds))

    def acceleration(state):
        system = system_of(mechanism, float)
        return lx.TangentSpace().prepared(system.dtype).derivative(system, jnp.zeros(()), state.q, state.v, True)[1]

    assert eqx.filter_eval_shape(acceleration, state).shape == (topology.num_speeds,)
