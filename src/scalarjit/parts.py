"""Functions of which XLA computes some operations: those that have no rule, and the loops and branches around these."""

import itertools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import lax
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Var

from scalarjit.factorisations import FACTORISATIONS
from scalarjit.rules import RULES
from scalarjit.rules.rule import Unsupported
from scalarjit.traced import by_implementation, called_by, check, inner_of, lengths_of_scan

LOOPS_AND_BRANCHES = ("cond", "while", "scan")

_able: dict[int, tuple[Any, bool]] = {}


def is_compilable(jaxpr: Jaxpr) -> bool:
    """Whether all that a function consists of has rules."""
    if id(jaxpr) not in _able:
        # What a function hands on as it is stands in no equation.
        _able[id(jaxpr)] = jaxpr, _have_scalars(jaxpr.invars, jaxpr.outvars) and all(map(_has_rule, jaxpr.eqns))
    return _able[id(jaxpr)][1]


def clear() -> None:
    _able.clear()


def _have_scalars(*atoms):
    try:
        for atom in itertools.chain(*atoms):
            check(atom.aval)
    except Unsupported:
        return False
    return True


def _has_rule(equation):
    if equation.effects or not _have_scalars(equation.invars, equation.outvars):
        return False
    try:
        name = equation.primitive.name
        if name in RULES or name in FACTORISATIONS:
            return True
        if name in LOOPS_AND_BRANCHES or called_by(name, equation.params):
            return all(map(is_compilable, inner_of(equation)))
        return is_compilable(by_implementation(equation).jaxpr)
    except Unsupported:
        return False


Known = tuple[Any, ...]  # what is known of each argument, or None
Compile = Callable[[ClosedJaxpr, Known], Callable[..., list[Any]]]


def in_parts(closed: ClosedJaxpr, known: Known, compile: Compile) -> Callable[..., list[Any]]:
    """A function, of which parts between what XLA computes are compiled. `compile`: makes a function of a part."""
    if is_compilable(closed.jaxpr):
        return compile(closed, known)
    return lambda *args: _computed(closed, known, args, compile)


def _computed(closed, known, args, compile):
    jaxpr = closed.jaxpr
    values: dict[Any, Any] = dict(zip(jaxpr.constvars, closed.consts, strict=True))
    values |= dict(zip(jaxpr.invars, args, strict=True))
    of_var = dict(zip(jaxpr.invars, known, strict=False))
    read = lambda atom: atom.val if isinstance(atom, Literal) else values[atom]
    for part in _parts(jaxpr):
        if len(part) == 1 and not _has_rule(part[0]):
            (equation,) = part
            of_operands = tuple(None if isinstance(atom, Literal) else of_var.get(atom) for atom in equation.invars)
            found = _by_xla(equation, of_operands, [read(atom) for atom in equation.invars], compile)
            values.update(zip(equation.outvars, found, strict=True))
            continue
        given, made = _ends(jaxpr, part)
        inner = jaxpr.replace(constvars=[], invars=given, outvars=made, eqns=part, debug_info=_unnamed(jaxpr))
        of_part = compile(ClosedJaxpr(inner, ()), tuple(map(of_var.get, given)))
        values.update(zip(made, of_part(*map(values.get, given)), strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _unnamed(jaxpr):
    return jaxpr.debug_info.with_unknown_names()


def _parts(jaxpr):
    """Equations that follow each other, as long as they have rules, and by themselves those that have none."""
    parts = []
    for equation in jaxpr.eqns:
        if not _has_rule(equation):
            parts += [[equation], []]
        else:
            parts[-1:] = [[*(parts[-1] if parts else []), equation]]
    return filter(None, parts)


def _ends(jaxpr, part):
    """What equations read that others made, and what they make that others read, or the function returns."""
    inside = {var for equation in part for var in equation.outvars}
    given: dict[Var, None] = {}
    for equation in part:
        given |= {atom: None for atom in equation.invars if not isinstance(atom, Literal) and atom not in inside}
    others = [atom for equation in jaxpr.eqns if equation not in part for atom in equation.invars]
    wanted = {atom for atom in (*others, *jaxpr.outvars) if not isinstance(atom, Literal)}
    return list(given), [var for equation in part for var in equation.outvars if var in wanted]


def _by_xla(equation, known, args, compile):
    """An operation of XLA, or a loop or branch around one."""
    params = equation.params
    name = equation.primitive.name
    if name == "cond":
        which, *operands = args
        return lax.switch(which, [in_parts(branch, known[1:], compile) for branch in params["branches"]], *operands)
    if name == "while":
        count = params["cond_nconsts"]
        more = count + params["body_nconsts"]
        test = in_parts(params["cond_jaxpr"], known[:count], compile)
        body = in_parts(params["body_jaxpr"], known[count:more], compile)
        going = lambda carry: test(*args[:count], *carry)[0]

        def turn(carry):
            found = body(*args[count:more], *carry)
            if not params["cond_jaxpr"].out_avals[0].shape:
                return found
            # Of a batch of loops, each goes on by itself: what has ended stays.
            goes_on = going(carry)
            aligned = lambda array: jnp.reshape(goes_on, goes_on.shape + (1,) * (array.ndim - goes_on.ndim))
            return [jnp.where(aligned(after), after, before) for before, after in zip(carry, found, strict=True)]

        return lax.while_loop(lambda carry: jnp.any(going(carry)), turn, args[more:])
    if name == "scan":
        count, num_carry = lengths_of_scan(params)
        more = count + num_carry
        body = in_parts(params["jaxpr"], known[:count], compile)

        def step(carry, rows):
            found = body(*args[:count], *carry, *rows)
            return found[: more - count], found[more - count :]

        carry, rows = lax.scan(step, args[count:more], args[more:], params["length"], params["reverse"])
        return [*carry, *rows]
    if name != "scalarised" and (closed := called_by(name, params)):
        return in_parts(closed, known, compile)(*args)
    found = equation.primitive.bind(*args, **params)
    return found if equation.primitive.multiple_results else [found]
