"""Derivatives that do not exist, as NaN.

JAX gives zero where a result does not follow its inputs, and zero says "at an optimum" to whoever descends along it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, PyTree

from linkax.xla.arrays import Array
from linkax.xla.derivatives import materialise
from linkax.xla.primitives import primitive


def infinite_where(missing: Bool[Array, "*rows"], values: PyTree[Array], inputs: PyTree) -> PyTree[Array]:
    """Infinity in rows of `values` that are missing, with undefined derivatives by `inputs`, see `undefined_where`."""
    return _missing(missing, values, inputs, jnp.inf)


def nan_where(missing: Bool[Array, ""], values: PyTree[Array], inputs: PyTree) -> PyTree:
    """NaN in place of all floating-point `values` that are missing, with undefined derivatives by `inputs`."""
    numbers, others = eqx.partition(values, eqx.is_inexact_array)
    return eqx.combine(_missing(missing, numbers, inputs, jnp.nan), others)


def _missing(missing, values, inputs, mark):
    across = lambda value: missing.reshape(missing.shape + (1,) * (value.ndim - missing.ndim))
    undefined = jax.tree.map(across, values)
    masked = jax.tree.map(lambda none, value: jnp.where(none, mark, value), undefined, values)
    return undefined_where(undefined, masked, inputs)


@eqx.filter_custom_jvp
def undefined_where(undefined: PyTree[Bool[Array, "..."]], values: PyTree[Array], inputs: PyTree) -> PyTree[Array]:
    """Return `values` as they are, with undefined derivatives by `inputs` where `undefined`.

    Forwards these are NaN. Backwards so are the cotangents of all inputs, unless the value has no cotangent: what a
    loss leaves out, such as failed members of a batch, spoils nothing. A cotangent that is NaN goes to all inputs, too.

    **Arguments:** `values`: pytree of arrays; `undefined`: of booleans that broadcast to them; `inputs`: what the
    values were computed from.
    """
    return values


@undefined_where.def_jvp
def _undefined_where_jvp(primals, tangents):
    (undefined, values, _), (_, to_values, to_inputs) = primals, tangents
    to_values, restored = ravel_pytree(jax.tree.map(materialise, values, to_values))
    undefined, _ = ravel_pytree(jax.tree.map(lambda none, of: jnp.broadcast_to(none, of.shape), undefined, values))
    # What all inputs have in common: through it their cotangents are reached. Of a batch, all of it is one.
    common = sum(map(jnp.sum, jax.tree.leaves(to_inputs)), jnp.zeros((), to_values.dtype))
    linear = jnp.append(to_values, common) + 0.0 * jnp.append(undefined, False)
    return values, restored(_spoiled(undefined, linear))


def _spoil(undefined, linear):
    # In both parts of a complex number.
    nan = complex(jnp.nan, jnp.nan) if jnp.iscomplexobj(linear) else jnp.nan
    return jnp.where(undefined, jnp.asarray(nan, linear.dtype), linear[:-1])


def _abstract(undefined, linear):
    return ShapedArray(undefined.shape, linear.dtype)


def _jvp(primals, tangents):
    (undefined, linear), (_, change) = primals, tangents
    return _spoil(undefined, linear), _spoiled(undefined, change)


def _transpose(arguments, cotangent):
    undefined, _ = arguments
    spoilt = undefined & (cotangent != 0.0) | jnp.isnan(cotangent)
    of_inputs = jnp.where(jnp.any(spoilt), jnp.nan, 0.0).astype(cotangent.dtype)
    # What computed the values sees none: linear solvers inside of it stop the whole program at one.
    return None, jnp.append(jnp.where(spoilt, 0.0, cotangent), of_inputs)


_spoiled = primitive("undefined_where", _spoil, _abstract, _jvp, _transpose)
