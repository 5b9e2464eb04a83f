"""Operations with rules of their own in both modes of differentiation, and loops that have reverse mode."""

import equinox.internal as eqxi


def primitive(name, evaluate, abstract, jvp, transpose):
    """A function as a primitive of JAX: only so can one function have a forward and a backward rule.

    **Arguments:** `abstract`: shapes of what `evaluate` returns; `jvp`: (primals, tangents) -> (value, tangent);
    `transpose`: (arguments, cotangent) -> cotangents of the arguments that the function is linear in, None for others.
    """
    made = eqxi.create_vprim(
        name,
        eqxi.filter_primitive_def(evaluate),
        eqxi.filter_primitive_def(abstract),
        eqxi.filter_primitive_jvp(jvp),
        eqxi.filter_primitive_transpose(transpose, materialise_zeros=True),
    )
    return lambda *arguments: eqxi.filter_primitive_bind(made, *arguments)


def bounded_while_loop(condition, body, begin, max_steps: int):
    """A `while` loop of at most `max_steps`, with derivatives in both modes."""
    return eqxi.while_loop(condition, body, begin, max_steps=max_steps, kind="bounded")
