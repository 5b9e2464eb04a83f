"""Calls that do not fit, and attributes that are not there, are told with what to write instead."""

import inspect
import pickle

import pytest
from mechanisms import pendulum

import linkax as lx
from linkax.model.calls import explain_slips

ARM = lx.rod("arm", 1.0, 1.0)
CALLS = {
    "a time by position": (
        lambda: lx.simulate(pendulum(), None, 5.0),
        r"simulate takes mechanism, state by position, and all else by name: give t1=5\.0",
    ),
    "what another argument has": (
        lambda: lx.simulate(pendulum(), None, t1=1.0, rtol=1e-6),
        r"no argument 'rtol', which is in accuracy: give accuracy=linkax\.Accuracy\(rtol=1e-06\); known: mechanism, ",
    ),
    "a slip of the pen": (
        lambda: lx.assemble(pendulum(), gues={}),
        r"argument 'gues' \(did you mean 'guess'\?\); known",
    ),
    "nothing to give": (lambda: lx.mobility(), "mobility needs mechanism, state; give mechanism=..., state=..."),
    "of a class": (lambda: lx.Revolute("pin", lx.GROUND, ARM), r"Revolute 'pin' needs axis; give axis=\.\.\."),
    "of its fields": (lambda: lx.Accuracy(rtoll=1.0), r"Accuracy has no argument 'rtoll' \(did you mean 'rtol'\?\)"),
    "too much": (lambda: lx.Plane(lx.GROUND, "y"), "Plane takes frame by position, and all else by name"),
}
LACKING = {
    "of a joint": (lambda: pendulum().joint("hinge").torque, r"Revolute has no 'torque'; .*linkax\.JointTorque"),
    "of a solution": (lambda: solution().torque("hinge"), r"Solution has no 'torque'; known: .*force\(element\)"),
    "a slip of the pen": (
        lambda: pendulum().bodie,
        r"Mechanism has no 'bodie' \(did you mean 'bodies'\?\); known: beams",
    ),
}


def solution():
    return lx.Solution.of_state(pendulum(), lx.State.as_drawn(pendulum()))


@pytest.mark.parametrize(("call", "told"), CALLS.values(), ids=CALLS)
def test_a_call_that_does_not_fit_is_told_what_does(call, told):
    with pytest.raises(TypeError, match=told):
        call()


@pytest.mark.parametrize(("read", "told"), LACKING.values(), ids=LACKING)
def test_an_attribute_that_is_not_there_is_told_what_is(read, told):
    with pytest.raises(AttributeError, match=told):
        read()


def test_errors_within_are_what_they_were():
    class Broken(lx.AbstractForce):
        @property
        def terms(self):
            return self.name.missing

        def load(self, t, motion):
            return None

    def within(number):
        raise TypeError("of its own")

    with pytest.raises(TypeError, match="of its own"):
        explain_slips({"within": within})["within"](1.0)
    with pytest.raises(AttributeError, match="Broken has no 'name'"):
        _ = Broken().terms


def test_functions_that_explain_are_those_of_their_modules():
    functions = [entry for entry in map(lx.__dict__.get, lx.__all__) if inspect.isfunction(entry)]
    assert len(functions) > 20
    for function in functions:
        assert pickle.loads(pickle.dumps(function)) is function


def test_results_print_in_words():
    assert "The run reached its end." in repr(solution().result)
    assert "massless" not in repr(lx.RESULTS.massless)  # it is its words
    assert all(lx.RESULTS[getattr(lx.RESULTS, name)] for name in ("successful", "max_steps_reached", "not_closed"))
