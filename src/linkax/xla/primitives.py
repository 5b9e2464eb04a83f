"""Functions with their own rules in both modes of differentiation, and loops that have reverse mode."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox.internal as eqxi
import jax
from jaxtyping import Bool

Carry = TypeVar("Carry")


def primitive(
    name: str,
    evaluate: Callable[..., Any],
    abstract: Callable[..., Any],
    jvp: Callable[[Any, Any], tuple[Any, Any]],
    transpose: Callable[[Any, Any], Any],
) -> Callable[..., Any]:
    """Make a primitive of JAX: only so can one function have a rule for each mode of differentiation.

    **Arguments:** `evaluate`: the function; `abstract`: shapes of its results; `jvp`: (primals, tangents) ↦ (value,
    tangent); `transpose`: (arguments, cotangent) ↦ cotangents, None for arguments in which the function is not linear.
    """
    made = eqxi.create_vprim(
        name,
        eqxi.filter_primitive_def(evaluate),
        eqxi.filter_primitive_def(abstract),
        eqxi.filter_primitive_jvp(jvp),
        eqxi.filter_primitive_transpose(transpose, materialise_zeros=True),
    )
    return lambda *arguments: eqxi.filter_primitive_bind(made, *arguments)


def bounded_while_loop(
    condition: Callable[[Carry], Bool[jax.Array, ""]], body: Callable[[Carry], Carry], begin: Carry, max_steps: int
) -> Carry:
    """Run a `while` loop of at most `max_steps` iterations, differentiable in both modes."""
    return eqxi.while_loop(condition, body, begin, max_steps=max_steps, kind="bounded")
