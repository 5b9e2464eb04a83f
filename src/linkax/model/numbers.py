"""Numbers of a model: which are traced, which are structure, and how they are checked.

Values that are known when a model is built are validated there. Values under a JAX
transformation are not known: one that cannot be becomes NaN (`require`), so that the solution's result tells.
"""

import numbers
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from linkax.spatial.rotations import COORDINATE_AXES


class Constant(eqx.Module):
    """An array that belongs to the structure of a mechanism: compared by value, never traced."""

    entries: tuple = eqx.field(static=True)

    def __init__(self, array):
        self.entries = _as_tuples(np.asarray(array, dtype=np.float64).tolist())

    @property
    def array(self) -> np.ndarray:
        return np.array(self.entries, dtype=np.float64)


def _as_tuples(nested):
    return tuple(map(_as_tuples, nested)) if isinstance(nested, list) else nested


def value(entry):
    """The array behind a `Constant`, or the traced array itself."""
    return entry.array if isinstance(entry, Constant) else entry


def concrete(number) -> np.ndarray | None:
    """The number as a NumPy array, or None while it is traced by a transformation."""
    return None if isinstance(number, jax.core.Tracer) else np.asarray(number)


def namespace(*arrays):
    """NumPy for arrays whose values are known, or jax.numpy where one is traced."""
    return np if all(concrete(array) is not None for array in arrays) else jnp


def number(entry, shape: tuple[int, ...], what: str):
    """A traced leaf of the given shape in double precision; `what` names it in errors."""
    array = real(entry, what)
    if array.shape != shape:
        expected = "a single number" if shape == () else f"an array of shape {shape}"
        raise ValueError(f"{what} has shape {array.shape}; it must be {expected}")
    return require(array, is_finite, what, "it must be finite")


def is_finite(array):
    """Whether all numbers of an array are."""
    known = concrete(array)
    return jnp.isfinite(array).all() if known is None else np.isfinite(known).all()


def real(entry, what: str):
    """Real numbers of any shape, in double precision; neither text, booleans nor None are taken for numbers."""
    return converted(entry, what, _in_double)


def _in_double(entry):
    if isinstance(entry, jax.Array):
        return jnp.asarray(entry, dtype=float)
    if any(isinstance(part, jax.Array) for part in jax.tree.leaves(entry)):
        return jnp.stack([jnp.asarray(part, dtype=float) for part in entry])
    array = np.array(entry, dtype=np.float64)  # not that of the caller, which may change
    array.flags.writeable = False
    return array


def converted(entry, what: str, convert):
    """What `convert` makes of an entry that holds real numbers alone."""
    try:
        if not all(map(_is_real, jax.tree.leaves(entry, is_leaf=lambda part: part is None))):
            raise TypeError("no real number")
        return convert(entry)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"{what} is {entry!r}; it must be a number or an array of numbers, real ones, none masked"
        ) from error


def _is_real(part) -> bool:
    if np.ma.is_masked(part):
        return False
    if getattr(part, "dtype", np.dtype(object)) == np.dtype(object):
        entries = np.ravel(part).tolist()
        return all(isinstance(entry, numbers.Real) and not isinstance(entry, bool) for entry in entries)
    return jnp.issubdtype(part.dtype, jnp.floating) or jnp.issubdtype(part.dtype, jnp.integer)


MOST = 2**31 - 1  # that counts may be


def whole_number(entry, what: str, least: int = 1, most: int = MOST) -> int:
    """An integer from `least` to `most`."""
    if isinstance(entry, bool) or not isinstance(entry, int | np.integer) or not least <= entry <= most:
        raise ValueError(f"{what} is {entry!r}; it must be an integer of at least {least} and at most {most}")
    return int(entry)


def require_bool(entry, what: str) -> bool:
    """True or False."""
    if not isinstance(entry, bool | np.bool_):
        raise ValueError(f"{what} is {entry!r}; give True or False")
    return bool(entry)


def one_of(entry, choices: tuple[str, ...], what: str) -> str:
    """One of several words."""
    if not isinstance(entry, str) or entry not in choices:
        raise ValueError(f"{what} is {entry!r}; known: {', '.join(map(repr, choices))}")
    return entry


def require_type(entry, kind, what: str, remedy: str):
    """Something of a kind, or of one of several."""
    if not isinstance(entry, kind):
        raise ValueError(f"{what} is {entry!r}; {remedy}")
    return entry


def listed(entries, kind, what: str, remedy: str) -> list:
    """A list of things of a kind, or of one of several."""
    try:
        found = list(entries)
    except TypeError as error:
        raise ValueError(f"{what} is {entries!r}; {remedy}") from error
    return [require_type(entry, kind, f"an entry of {what}", remedy) for entry in found]


def require(array, condition, what: str, remedy: str):
    """An array that meets a condition.

    Where the condition is known, it raises a ValueError if it fails; where it is traced, an array that fails it is
    NaN, which the result of a simulation tells.
    """
    known = concrete(array)
    met = condition(lax.stop_gradient(array) if known is None else known)
    if concrete(met) is None:
        return jnp.where(met, array, jnp.nan)
    if not met:
        raise ValueError(f"{what} is {known.tolist()}; {remedy}")
    return array


def positive(entry, what: str, remedy: str = "it must be positive"):
    """A positive number."""
    return require(number(entry, (), what), lambda x: x > 0.0, what, remedy)


def zero_or_more(entry, what: str):
    """A number that is not negative."""
    return require(number(entry, (), what), lambda x: x >= 0.0, what, "it must be zero or more")


def unit_axis(axis, what: str):
    """A unit vector from a name ("x", "-z"), numbers (structure), or a JAX array (traced)."""
    if isinstance(axis, str):
        if axis not in COORDINATE_AXES:
            known_axes = ", ".join(COORDINATE_AXES)
            raise ValueError(f"{what} is {axis!r}; known names are {known_axes}, or give a vector")
        return Constant(COORDINATE_AXES[axis])
    remedy = "its length is zero or infinite; give a nonzero vector of finite length"
    vector = require(number(axis, (3,), what), lambda entries: _is_length(_norm(entries)), what, remedy)
    unit = vector / _norm(vector)
    return Constant(unit) if isinstance(vector, np.ndarray) else unit


def _norm(vector):
    with np.errstate(over="ignore", under="ignore"):
        return np.linalg.norm(vector) if isinstance(vector, np.ndarray) else jnp.linalg.norm(vector)


def _is_length(length):
    return (length > 0.0) & (length < np.inf)


def perpendicular_axes(first, axis, what: str):
    """Two unit vectors, the first as `unit_axis` made it, the second from `axis` and checked to be at a right angle."""
    second = unit_axis(axis, what)
    one, other = value(first), value(second)
    cosine = concrete(one @ other)
    angle = "" if cosine is None else f", at {np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))):.6g} degrees"
    remedy = f"it must be at a right angle to the first axis{angle}"
    checked = partial(require, condition=lambda _: abs(one @ other) <= 1e-12, what=what, remedy=remedy)
    checked(other)
    mark = lambda unit: unit if isinstance(unit, Constant) else checked(unit)
    return mark(first), mark(second)


def rotation_matrix(rotation, what: str):
    """A rotation: None (identity) and numbers are structure, a JAX array is traced."""
    if rotation is None:
        return Constant(np.eye(3))
    remedy = "its columns must be the orthonormal, right-handed axes of the frame"
    matrix = require(number(rotation, (3, 3), what), _is_rotation, what, remedy)
    return Constant(matrix) if isinstance(matrix, np.ndarray) else matrix


def _is_rotation(matrix):
    xp = namespace(matrix)
    return xp.allclose(matrix @ matrix.T, np.eye(3), atol=1e-9) & (xp.linalg.det(matrix) > 0.0)
