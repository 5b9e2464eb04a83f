"""Functions compared by what they compute: the same made anew, others where anything that they read is another."""

import collections
import contextvars
import dataclasses
import fractions
import functools
import inspect
import math
import operator
import os
import sys
import threading
import types
import weakref
from enum import Enum

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scalarjit.code import Code
from scalarjit.code_walk import NotComparable

SPEED, TABLE, NUMBERS = 2.0, {"speed": [2.0, 3.0]}, np.arange(3.0)
settings = types.ModuleType("settings")  # as of a file of the user
settings.speed, settings.other = 2.0, object()


def at_speed(t):
    return SPEED * t


class Motor:
    gear = 3.0

    def __init__(self, speed):
        self.speed, self.last = speed, None

    def turn(self, t):
        return self.gear * self.speed * at_speed(t)

    def __call__(self, t):
        return self.turn(t)

    @property
    def twice(self):
        return 2.0 * self.speed


class Wave(eqx.Module):
    size: jax.Array
    law: types.FunctionType = eqx.field(default=jnp.sin)

    def __call__(self, t):
        return self.size * self.law(t)

    def doubled(self, t):
        return 2.0 * self(t)


def scaled(factor):
    def outer(t):
        inner = lambda t: factor * t
        return inner(t)

    return outer


def deep(values):
    law, other = lambda t: values["of"][0] * t, scaled(values["by"])
    return lambda t, also=other: law(t) + also(t)


def reading_an_attribute(name):
    return lambda t: getattr(settings, name) * t


def of_itself():
    def law(t, depth=2):
        return t if depth == 0 else law(t, depth - 1)

    return law


def counting():
    count = 0

    def law(t):
        nonlocal count
        count += 1
        return t

    return law


@dataclasses.dataclass(slots=True)
class Slots:
    speed: float


class Other(dict):
    def __getattr__(self, name):
        return self[name]


class Geared(Motor):
    made = 0

    def __init__(self, speed):
        Geared.made += 1
        super().__init__(speed)

    def turn(self, t):
        return super().turn(t)


@dataclasses.dataclass
class Gain:
    speed: float = 2.0


class Plain:
    __match_args__ = ("speed",)


class Converted(eqx.Module):
    speed: float = eqx.field(converter=at_speed)


class Mode(Enum):
    FAST = np.array([2.0])


class Fast:
    def __init__(self):
        self.speed = SPEED

    @classmethod
    def anew(cls):
        return cls()


class Saved:
    __slots__ = ("speed",)

    def __getstate__(self):
        return None


class Ratio(fractions.Fraction):
    pass


class Size(np.float64):
    pass


@functools.singledispatch
def dispatched(t):
    return 2.0 * t


def matched(value):
    def law(t):
        match value:
            case Plain(speed=found):
                return found * t

    return law


def matched_in_place(value):
    def law(t):
        match value:
            case Plain(found):
                return found * t

    return law


def of_class(meta=type, **methods):
    return meta("Own", (), methods)


def with_speed(value):
    value.speed = 2.0
    return value


_, LINEAR = jax.linearize(jnp.sin, 1.0)
MADE = {
    "no variables": lambda: lambda t: 2.0 * jnp.sin(math.pi * t),
    "a number": lambda: scaled(2.0),
    "text and None": lambda: (lambda word, none: lambda t: t if word == "x" and none is None else 0.0)("x", None),
    "an array of NumPy": lambda: scaled(np.arange(3.0)),
    "containers and functions": lambda: deep({"of": [2.0, (1, 2)], "by": 3.0}),
    "defaults": lambda: lambda t, k=2.0, *, other=(3.0,): k * other[0] * t,
    "globals": lambda: lambda t: at_speed(t) + TABLE["speed"][0] + NUMBERS[1],
    "a module": lambda: lambda t: settings.speed * t,
    "a partial": lambda: functools.partial(scaled(2.0)),
    "a partial of JAX": lambda: jax.tree_util.Partial(lambda k, t: k * t, 2.0),
    "a method": lambda: Motor(2.0).turn,
    "something to call": lambda: Motor(2.0),
    "attributes": lambda: (lambda motor: lambda t: motor.twice * t)(Motor(2.0)),
    "a method of a pytree": lambda: Wave(jnp.array(2.0)).doubled,
    "a pytree": lambda: Wave(jnp.array(2.0), lambda t: t**2),
    "a function of JAX": lambda: jnp.sin,
    "a function made by JAX": lambda: (lambda slope: lambda t: slope(t))(jax.grad(lambda t: SPEED * t**2)),
    "names made when it runs": lambda: reading_an_attribute("speed"),
    "a function of itself": of_itself,
    "many numbers": lambda: (lambda values: lambda t: values[0] * t)([0.0] * 20_000),
    "an object of a library": lambda: (lambda queue: lambda t: queue[0] * t)(collections.deque([2.0])),
    "slots": lambda: (lambda slots: lambda t: slots.speed * t)(Slots(2.0)),
    "a class": lambda: lambda t: Motor(Gain().speed).turn(t),
    "a pattern": lambda: matched(with_speed(Plain())),
    "an enumeration": lambda: lambda t: Mode["FAST"].value[0] * t,
    "a function by the type of what it is given": lambda: lambda t: dispatched(t),
    "what cannot be written to": lambda: (lambda table: lambda t: table["k"] * t)(types.MappingProxyType({"k": 2.0})),
    "a linearised function": lambda: lambda t: LINEAR(t),
}


@pytest.mark.parametrize("made", MADE.values(), ids=MADE)
def test_a_function_made_anew_is_the_same(made):
    (one, numbers), (other, others) = Code.of(made()), Code.of(made())
    assert one == other
    assert hash(one) == hash(other)
    np.testing.assert_array_equal(one.with_numbers(numbers)(0.3), made()(0.3))
    assert not one.has_changed()
    assert len(numbers) == len(others)


UNLIKE = {
    "numbers": (scaled(2.0), scaled(3.0)),
    "a whole number": (scaled(2), scaled(2.0)),
    "zeros of unlike sign": (scaled(0.0), scaled(-0.0)),
    "true and one": (scaled(True), scaled(1)),
    "types of arrays": (scaled(np.arange(3)), scaled(np.arange(3.0))),
    "shapes": (scaled(np.zeros((2, 1))), scaled(np.zeros((1, 2)))),
    "code": (lambda t: t + 1.0, lambda t: t + 2.0),
    "constants of unlike type": (lambda t: t * 1, lambda t: t * 1.0),
    "order of entries": (deep({"of": [1.0], "by": 1.0}), deep({"by": 1.0, "of": [1.0]})),
    "defaults": (functools.partial(MADE["defaults"]()), functools.partial(MADE["defaults"](), 3.0)),
    "an array for a number": (scaled(2.0), scaled(jnp.array(2.0))),
    "attributes": (Motor(2.0).turn, Motor(3.0).turn),
    "objects that are only themselves": (scaled(object()), scaled(object())),
    "programs of JAX": (scaled(jax.jit(lambda t: t)), scaled(jax.jit(lambda t: t))),
    "functions in pytrees": (Wave(jnp.array(2.0), lambda t: t), Wave(jnp.array(2.0), lambda t: -t)),
}


@pytest.mark.parametrize("pair", UNLIKE.values(), ids=UNLIKE)
def test_functions_that_differ_are_not_the_same(pair):
    one, other = (Code.of(function)[0] for function in pair)
    assert one != other


def within(values):
    return lambda t: t if values["of"][0].lock.locked() else 0.0


def _reading(value):
    return lambda t: 0.0 if value is None else t


REFUSED = {
    "of a system": (lambda: _reading(threading.Lock()), r"value, a _thread\.lock, which cannot be compared"),
    "a generator": (lambda: _reading(t for t in ()), r"value, a builtins\.generator, which cannot be compared"),
    "within": (lambda: within({"of": [types.SimpleNamespace(lock=threading.Lock())]}), r"values\.of\.lock, a _thread"),
    "too much": (lambda: _reading([0.0] * 200_000), "value, more than 100000 values"),
    "anything": (lambda: lambda t: globals()["SPEED"] * t, "globals, by which code can read anything"),
    "a frame": (lambda: lambda t: sys._getframe().f_globals["SPEED"], "f_globals, by which code can read anything"),
    "anything by another name": (lambda: (lambda read: lambda t: read()["SPEED"])(globals), "read.globals, by which"),
    "a weak reference": (lambda: _reading(weakref.ref(MOTOR)), r"value, a weakref\.ReferenceType, which cannot"),
    "weak references": (lambda: _reading(weakref.WeakSet([MOTOR])), r"value, a _weakrefset\.WeakSet, which cannot"),
    "of a context": (lambda: _reading(contextvars.ContextVar("k")), r"value, a _contextvars\.ContextVar, which cannot"),
    "memory": (lambda: _reading(memoryview(bytearray(1))), r"value, a builtins\.memoryview, which cannot"),
    "within a function of JAX's": (lambda: _reading(jax.grad(scaled(threading.Lock()))), "value.*factor, a _thread"),
}


@pytest.mark.parametrize(("made", "told"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_compared_is_refused_by_name(made, told):
    with pytest.raises(NotComparable, match=f"^{told}"):
        Code.of(made())


def test_one_that_changes_what_it_reads_is_refused_when_it_is_called_again():
    law = counting()
    code, _ = Code.of(law)
    law(0.0)
    assert code.has_changed()


def _closed_over(change):
    values = {"of": [2.0], "by": 3.0}
    return deep(values), lambda _: change(values)


def _changes(value, law, change=lambda value: setattr(value, "speed", 3.0)):
    return law(value), lambda _: change(value)


ARRAY, MOTOR = np.arange(3.0), Motor(2.0)
SLOPE, COMPILED = jax.grad(at_speed), jax.jit(at_speed)
CHANGES = {
    "an entry of a dictionary": _closed_over(lambda values: values.update(by=4.0)),
    "an entry of a list": _closed_over(lambda values: values["of"].append(1.0)),
    "a number for an array": _closed_over(lambda values: values.update(by=jnp.array(3.0))),
    "entries of an array": (scaled(ARRAY), lambda _: ARRAY.__setitem__(0, 1.0)),
    "a global": (MADE["globals"](), lambda patch: patch.setitem(globals(), "SPEED", 3.0)),
    "an entry of a global": (MADE["globals"](), lambda patch: patch.setitem(TABLE, "speed", [3.0])),
    "a function that it calls": (MADE["globals"](), lambda patch: patch.setitem(globals(), "at_speed", abs)),
    "an attribute of a module": (MADE["a module"](), lambda patch: patch.setattr(settings, "speed", 3.0)),
    "an attribute": (MOTOR.turn, lambda patch: patch.setattr(MOTOR, "speed", 3.0)),
    "an attribute of a class": (Motor(1.0), lambda patch: patch.setattr(Motor, "gear", 1.0)),
    "slots": ((lambda slots: (lambda t: slots.speed, lambda _: setattr(slots, "speed", 3.0)))(Slots(2.0))),
    "a queue": ((lambda queue: (lambda t: queue[0], lambda _: queue.append(3.0)))(collections.deque([2.0]))),
    "an attribute by name": (reading_an_attribute("speed"), lambda patch: patch.setattr(settings, "speed", 3.0)),
    "a dictionary with attributes": ((lambda other: (lambda t: other.k, lambda _: other.update(k=3.0)))(Other(k=2.0))),
    "the environment": (lambda t: float(os.environ["TORQUE"]), lambda patch: patch.setenv("TORQUE", "5")),
    "a function of JAX's": (lambda t: SLOPE(t), lambda patch: patch.setitem(globals(), "SPEED", 3.0)),
    "a compiled one": (lambda t: COMPILED(t), lambda patch: patch.setitem(globals(), "SPEED", 3.0)),
    "a class of a pytree": (Wave(jnp.array(2.0)), lambda patch: patch.setattr(Wave, "__call__", lambda self, t: t)),
    "a global that a method reads": (Motor(4.0).turn, lambda patch: patch.setitem(globals(), "SPEED", 3.0)),
}
FASTER = lambda patch: patch.setitem(globals(), "SPEED", 3.0)
# Methods that Python calls, of a class of which code may make objects.
METHODS = ("__init__", "__new__", "__post_init__", "__class_getitem__", "__eq__", "__hash__", "__str__", "__setattr__")
CHANGES |= {name: (scaled(of_class(**{name: at_speed})), FASTER) for name in METHODS}
META = type("Meta", (type,), {"__call__": at_speed, "speed": property(at_speed)})
CHANGES |= {
    "a method that is compiled": (scaled(of_class(__call__=jax.jit(at_speed))()), FASTER),
    "a default of a class": (lambda t: Gain(), lambda patch: patch.setattr(Gain.__init__, "__defaults__", (3.0,))),
    "a converter of a field": (lambda t: Converted(t), FASTER),
    "a method that super reads": (Geared(2.0).turn, lambda patch: patch.setattr(Motor, "gear", 1.0)),
    "an object made by a method of a class": ((lambda fast: lambda t: fast.anew().speed)(Fast()), FASTER),
    "an object made by the class of another": ((lambda fast: lambda t: type(fast)().speed)(Fast()), FASTER),
    "a call of a metaclass": (scaled(of_class(META)), FASTER),
    "an attribute of a metaclass": ((lambda kind: lambda t: kind.speed)(of_class(META)), FASTER),
    "an attribute in a pattern": _changes(with_speed(Plain()), matched),
    "an attribute by its place in a pattern": _changes(with_speed(Plain()), matched_in_place),
    "an attribute by a format": _changes(
        with_speed(Plain()), lambda value: (lambda text: lambda t: text.format(value))("{0.speed}")
    ),
    "that there is an attribute": _changes(
        with_speed(Plain()), lambda value: lambda t: hasattr(value, "speed"), lambda value: delattr(value, "speed")
    ),
    "a value of an enumeration": (MADE["an enumeration"](), lambda _: Mode.FAST.value.__setitem__(0, 3.0)),
    "an attribute of a member": _changes(with_speed(Mode.FAST), lambda mode: lambda t: mode.speed),
    "slots of what saves none": _changes(with_speed(Saved()), lambda saved: lambda t: saved.speed),
    "an attribute of a number": _changes(with_speed(Ratio(1)), lambda ratio: lambda t: ratio.speed),
    "an attribute of a number of NumPy's": _changes(with_speed(Size(1)), lambda size: lambda t: size.speed),
    "what is in a frozen set": _changes(
        Motor(2.0), lambda motor: (lambda motors: lambda t: sum(each.speed for each in motors))(frozenset([motor]))
    ),
    "a method of a list": _changes([2.0], lambda values: scaled(values.__len__), lambda values: values.append(3.0)),
    "what is behind a view": _changes(
        {"k": 2.0}, lambda table: scaled(types.MappingProxyType(table)), lambda table: table.update(k=3.0)
    ),
    "a function for a type": (
        MADE["a function by the type of what it is given"](),
        lambda _: dispatched.register(float)(abs),
    ),
}
READERS = {
    "attrgetter": lambda value: operator.attrgetter("speed"),
    "methodcaller": lambda value: operator.methodcaller("turn", 1.0),
    "getattr": lambda value: getattr,
    "a partial of getattr": lambda value: functools.partial(getattr, value, "speed"),
    "getattr_static": lambda value: inspect.getattr_static,
    "vars": lambda value: vars,
    "__getattribute__": lambda value: value.__getattribute__,
    "object.__getattribute__": lambda value: object.__getattribute__,
    "format": lambda value: "{0.speed}".format,
}
CHANGES |= {
    f"an attribute by {name}": _changes(
        with_speed(Plain()), lambda value, made=made: (lambda read: lambda t: read(value))(made(value))
    )
    for name, made in READERS.items()
}


@pytest.mark.parametrize(("function", "change"), CHANGES.values(), ids=CHANGES)
def test_changes_of_what_a_function_reads_are_seen(function, change, monkeypatch):
    code, _ = Code.of(function)
    assert not code.has_changed()
    change(monkeypatch)
    assert code.has_changed()
    assert code != Code.of(function)[0]


@pytest.mark.parametrize("made", [jax.jit, eqx.filter_jit, functools.cache], ids=lambda made: made.__module__)
def test_a_function_that_keeps_what_it_has_read_reads_it_anew(made, monkeypatch):
    kept = made(at_speed)
    law = lambda t: kept(t)
    for speed in (2.0, 3.0):
        monkeypatch.setitem(globals(), "SPEED", speed)
        code, numbers = Code.of(law)
        assert code.with_numbers(numbers)(0.5) == 0.5 * speed


def test_another_array_in_place_of_one_is_seen():
    values = {"of": [2.0], "by": jnp.array(3.0)}
    code, _ = Code.of(deep(values))
    values["by"] = jnp.array(4.0)
    assert code.has_changed()


def test_what_code_does_not_name_may_change():
    motor = Motor(2.0)
    code, _ = Code.of(motor.turn)
    motor.last, settings.other = object(), None
    assert not code.has_changed()


def test_what_making_other_objects_changes_is_not_seen():
    code, _ = Code.of(Geared(2.0).turn)
    Geared(3.0)
    assert not code.has_changed()


OF_ARRAY = {
    "closed over": scaled,
    "in containers": lambda x: deep({"of": [x], "by": x}),
    "default": lambda x: lambda t, k=x: k * t,
    "of a partial": lambda x: functools.partial(lambda k, t: k * t, x),
    "of a partial of JAX": lambda x: jax.tree_util.Partial(lambda k, t: k * t, x),
    "of a pytree": lambda x: Wave(x),
    "of a pytree that is closed over": lambda x: lambda t: Wave(x).doubled(t),
    "of a method": lambda x: Wave(x).doubled,
}


@pytest.mark.parametrize("of", OF_ARRAY.values(), ids=OF_ARRAY)
def test_arrays_are_numbers_of_a_function(of):
    one, other = jnp.array([2.0, 3.0]), jnp.array([4.0, 5.0])
    (code, numbers), (again, _) = Code.of(of(one)), Code.of(of(other))
    assert code == again
    assert all(number is one for number in numbers)
    np.testing.assert_array_equal(code.with_numbers([other] * len(numbers))(0.3), of(other)(0.3))
    through = jax.jacfwd(lambda x: code.with_numbers([x] * len(numbers))(0.3))
    np.testing.assert_array_equal(through(one), jax.jacfwd(lambda x: of(x)(0.3))(one))
    traced = jax.jacfwd(lambda x: (found := Code.of(of(x)))[0].with_numbers(found[1])(0.3))
    np.testing.assert_array_equal(traced(one), jax.jacfwd(lambda x: of(x)(0.3))(one))
