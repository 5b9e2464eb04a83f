"""Numbers of a model: which are traced, which are structure, and how they are checked.

Values that are known when a model is built are validated there. Values under a JAX
transformation are not known; they are passed on, and a bad one shows in the solution's result.
"""

import numbers

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

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


def known(number) -> np.ndarray | None:
    """The number as a NumPy array, or None while it is traced by a transformation."""
    return None if isinstance(number, jax.core.Tracer) else np.asarray(number)


def number(entry, shape: tuple[int, ...], what: str):
    """A traced leaf of the given shape in double precision; `what` names it in errors."""
    array = real(entry, what)
    if array.shape != shape:
        expected = "a single number" if shape == () else f"an array of shape {shape}"
        raise ValueError(f"{what} has shape {array.shape}; it must be {expected}")
    return require(array, lambda concrete: np.all(np.isfinite(concrete)), what, "it must be finite")


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
        raise ValueError(f"{what} is {entry!r}; it must be a number or an array of numbers, real ones") from error


def _is_real(part) -> bool:
    if getattr(part, "dtype", np.dtype(object)) == np.dtype(object):
        entries = np.ravel(part).tolist()
        return all(isinstance(entry, numbers.Real) and not isinstance(entry, bool) for entry in entries)
    return jnp.issubdtype(part.dtype, jnp.floating) or jnp.issubdtype(part.dtype, jnp.integer)


def whole_number(entry, what: str, least: int = 1) -> int:
    """An integer of at least `least`."""
    if isinstance(entry, bool) or not isinstance(entry, int | np.integer) or entry < least:
        raise ValueError(f"{what} is {entry!r}; it must be an integer of at least {least}")
    return int(entry)


def flag(entry, what: str) -> bool:
    """True or False."""
    if not isinstance(entry, bool | np.bool_):
        raise ValueError(f"{what} is {entry!r}; give True or False")
    return bool(entry)


def instance(entry, kind, what: str, remedy: str):
    """Something of a kind, or of one of several."""
    if not isinstance(entry, kind):
        raise ValueError(f"{what} is {entry!r}; {remedy}")
    return entry


def require(array, condition, what: str, remedy: str):
    """Raise a ValueError where `condition` fails on an array whose values are known."""
    concrete = known(array)
    if concrete is not None and not condition(concrete):
        raise ValueError(f"{what} is {concrete.tolist()}; {remedy}")
    return array


def unit_axis(axis, what: str):
    """A unit vector from a name ("x", "-z"), numbers (structure), or a JAX array (traced)."""
    if isinstance(axis, str):
        if axis not in COORDINATE_AXES:
            known_axes = ", ".join(COORDINATE_AXES)
            raise ValueError(f"{what} is {axis!r}; known names are {known_axes}, or give a vector")
        return Constant(COORDINATE_AXES[axis])
    vector = number(axis, (3,), what)
    with np.errstate(over="ignore", under="ignore"):
        length = np.linalg.norm(vector) if isinstance(vector, np.ndarray) else jnp.linalg.norm(vector)
    if known(length) is not None and not 0.0 < known(length) < np.inf:
        size = "zero" if length == 0.0 else "infinite"
        raise ValueError(f"{what} has {size} length: {known(vector).tolist()}; give a nonzero vector of finite length")
    return Constant(vector / length) if isinstance(vector, np.ndarray) else vector / length


def perpendicular_axis(axis, first, what: str):
    """A unit vector like `unit_axis`, checked to be at a right angle to another."""
    second = unit_axis(axis, what)
    one, other = known(value(first)), known(value(second))
    if one is not None and other is not None and abs(cosine := float(one @ other)) > 1e-12:
        raise ValueError(
            f"{what} is {other.tolist()}, at {np.degrees(np.arccos(cosine)):.6g} degrees to the first axis "
            f"{one.tolist()}; it must be at a right angle to it"
        )
    return second


def rotation_matrix(rotation, what: str):
    """A rotation: None (identity) and numbers are structure, a JAX array is traced."""
    if rotation is None:
        return Constant(np.eye(3))
    matrix = number(rotation, (3, 3), what)
    require(
        matrix,
        lambda entries: np.allclose(entries @ entries.T, np.eye(3), atol=1e-9) and np.linalg.det(entries) > 0,
        what,
        "its columns must be the orthonormal, right-handed axes of the frame",
    )
    return Constant(matrix) if isinstance(matrix, np.ndarray) else matrix
