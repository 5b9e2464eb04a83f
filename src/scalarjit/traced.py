"""What JAX has traced: functions in equations, their sizes, and who reads a variable last."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from scalarjit.operations import is_supported
from scalarjit.rules.rule import Unsupported


def check(aval):
    if getattr(aval, "dtype", None) == jax.dtypes.float0:
        return
    if not hasattr(aval, "shape") or not has_scalars(aval.dtype):
        raise Unsupported(f"arrays of {aval}")


def has_scalars(dtype: Any) -> bool:
    """Whether scalars of a type of JAX's are computed; it has some of its own, such as that of keys."""
    return not jnp.issubdtype(dtype, jax.dtypes.extended) and is_supported(np.dtype(dtype))


def stays_as_it_is(jaxpr, num_consts, numbers):
    """Whether the body of a loop returns each of the carried arrays as it is."""
    return [jaxpr.outvars[number] is jaxpr.invars[num_consts + number] for number in numbers]


def lengths_of_scan(params: dict[str, Any]) -> tuple[int, int]:
    """How many constants and how many carried arrays a scan has; JAX 0.12 says so in another way."""
    if "num_consts" in params:
        return params["num_consts"], params["num_carry"]
    parts = [0 if part is None else len(part) for part in params["ft_in"].unpack()]
    return parts[0], parts[1]


def called_by(name: str, params: dict[str, Any]) -> ClosedJaxpr | None:
    """The function that an equation calls, if it does."""
    for key in ("call_jaxpr", "fun_jaxpr", "jaxpr"):
        inner = params.get(key)
        if isinstance(inner, ClosedJaxpr):
            return inner
        if isinstance(inner, Jaxpr):
            return closed_of(inner)
    return None


_closed: dict[int, ClosedJaxpr] = {}


def closed_of(jaxpr: Jaxpr) -> ClosedJaxpr:
    """One closed function for each open one, so that it is found again."""
    if id(jaxpr) not in _closed:
        _closed[id(jaxpr)] = ClosedJaxpr(jaxpr, ())
    return _closed[id(jaxpr)]


_ordered: dict[Any, tuple[Any, ClosedJaxpr]] = {}


def in_order(closed: ClosedJaxpr, order: tuple[int, ...]) -> ClosedJaxpr:
    """The same function of its arguments in another order."""
    key = id(closed), order
    if key not in _ordered:
        jaxpr = closed.jaxpr
        inner = jaxpr.replace(
            invars=[jaxpr.invars[number] for number in order], debug_info=jaxpr.debug_info.with_unknown_names()
        )
        _ordered[key] = closed, ClosedJaxpr(inner, closed.consts)
    return _ordered[key][1]


_implementations: dict[Any, ClosedJaxpr] = {}


def by_implementation(equation) -> ClosedJaxpr:
    """What a primitive that is computed by other primitives is made of."""
    avals = tuple((var.aval.shape, np.dtype(var.aval.dtype)) for var in equation.invars)
    primitive = equation.primitive
    try:
        key = (primitive, avals, tuple(sorted(equation.params.items(), key=lambda item: item[0])))
        hash(key)
    except TypeError:
        key = None
    if key in _implementations:
        return _implementations[key]
    shapes = [jax.ShapeDtypeStruct(*aval) for aval in avals]
    compute = lambda *args: primitive.impl(*args, **equation.params)
    try:
        closed = jax.make_jaxpr(compute)(*shapes)
    except Exception as error:
        raise Unsupported(f"primitive {primitive.name}") from error
    if any(inner.primitive is primitive for inner in all_equations(closed.jaxpr)):
        raise Unsupported(f"primitive {primitive.name}")
    if key is not None:
        _implementations[key] = closed
    return closed


def all_equations(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        for inner in inner_of(equation):
            yield from all_equations(inner)


def inner_of(equation):
    """Functions, branches and bodies in an equation."""
    for value in equation.params.values():
        for part in value if isinstance(value, tuple | list) else (value,):
            if isinstance(part, ClosedJaxpr | Jaxpr):
                yield part.jaxpr if isinstance(part, ClosedJaxpr) else part


_sizes: dict[int, tuple[Any, int]] = {}


def num_equations(jaxpr: Jaxpr) -> int:
    """Count equations, with those of functions, branches and bodies in them."""
    if id(jaxpr) not in _sizes:
        total = sum(1 + sum(map(num_equations, inner_of(equation))) for equation in jaxpr.eqns)
        _sizes[id(jaxpr)] = jaxpr, total
    return _sizes[id(jaxpr)][1]


_used: dict[int, Any] = {}


def uses_of(jaxpr):
    """How often each variable is read, and which are read last by each equation."""
    if id(jaxpr) not in _used:
        uses: dict[Any, int] = {}
        by: dict[Any, int] = {}
        for number, equation in enumerate(jaxpr.eqns):
            for atom in equation.invars:
                if not isinstance(atom, Literal):
                    uses[atom] = uses.get(atom, 0) + 1
                    by[atom] = number
        for atom in jaxpr.outvars:
            if not isinstance(atom, Literal):
                uses[atom] = uses.get(atom, 0) + 1
                by.pop(atom, None)
        last: dict[int, list[Any]] = {}
        for atom, number in by.items():
            last.setdefault(number, []).append(atom)
        _used[id(jaxpr)] = jaxpr, (uses, last)
    return _used[id(jaxpr)][1]


def clear() -> None:
    """Forget what functions have been found to be."""
    for kept in _closed, _ordered, _implementations, _sizes, _used:
        kept.clear()
