"""Classes of a user may define what linkax leaves open, new names, and none that linkax has for itself."""

import inspect
from types import FunctionType

import pytest

import linkax as lx

OPEN = (lx.AbstractForce, lx.AbstractConstraint, lx.AbstractJoint, lx.AbstractSensor)


def names():
    """All names that public abstract classes have, each with the class that has it, and whether it is open."""
    for kind in OPEN:
        for base in kind.__mro__:
            if base.__module__.startswith("linkax."):
                of_base = {*vars(base), *inspect.get_annotations(base)}
                yield from ((kind, name, name in kind._open) for name in of_base if not name.startswith("__"))


def subclass(kind, name, value=None, annotation=None):
    namespace = {"__module__": __name__, "__qualname__": "Own"}
    namespace |= {"__annotations__": {name: annotation}} if annotation else {name: value}
    return type(kind)("Own", (kind,), namespace)


def test_all_names_of_abstract_classes_are_open_or_refused():
    found = [(kind, name) for kind, name, is_open in names() if not is_open and not name.startswith("_abc")]
    assert len(found) > 30
    for kind, name in found:
        for changes in ({"value": lambda self: None}, {"value": 1.0}, {"annotation": float}):
            if name in {field for field in inspect.get_annotations(kind)}:
                continue  # a field, which is public
            with pytest.raises(TypeError, match=f"Own defines '{name}', which .* has for itself; give it another name"):
                subclass(kind, name, **changes)


def test_open_names_are_those_of_linkax_and_may_be_defined():
    for kind in OPEN:
        known = {name for each, name, _ in names() if each is kind}
        assert kind._open - {"name"} <= known
        for name in kind._open:
            own = inspect.getattr_static(kind, name, None)
            if isinstance(own, FunctionType):
                subclass(kind, name, lambda self, *args: None)
                for changes in ({"value": 1.0}, {"annotation": float}):
                    with pytest.raises(TypeError, match=f"Own has a field '{name}', and .* a method or property"):
                        subclass(kind, name, **changes)
            if isinstance(own, property):
                subclass(kind, name, property(lambda self: None))
                with pytest.raises(TypeError, match=f"Own has a field '{name}', and .* a method or property"):
                    subclass(kind, name, annotation=tuple)


def test_other_names_are_a_users_own():
    for name in ("strut", "beam", "angle", "range", "law"):
        assert subclass(lx.AbstractForce, name, annotation=float)
