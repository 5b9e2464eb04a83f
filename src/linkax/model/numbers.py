"""Numbers of a model: which are traced, which are structure, and how they are checked.

Values known when a model is built are checked there. Values that a JAX transformation traces are not known; one
that fails a check becomes NaN (`require`), and the solution's result tells.
"""

import numbers
from collections.abc import Callable, Sequence
from functools import partial
from types import ModuleType
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.spatial.rotations import COORDINATE_AXES
from linkax.xla.arrays import Array, Scalar, can_change
from linkax.xla.tracing import concrete, without_derivatives

# What a user may give for a number, for several, for a matrix, and for a direction (by name, as "-x").
Number = float | int | np.number | Array
Vector = Array | Sequence[Number]
Matrix = Array | Sequence[Number] | Sequence[Vector]
Axis = str | Vector

Kind = TypeVar("Kind")
Tree = TypeVar("Tree")
Word = TypeVar("Word", bound=str)
Kinds = Any  # a class, or several, as `isinstance` takes them


class Constant(eqx.Module):
    """An array in the structure of a mechanism: compared by value, never traced."""

    entries: tuple = eqx.field(static=True)

    def __init__(self, array: np.ndarray) -> None:
        self.entries = _as_tuples(np.asarray(array, dtype=np.float64).tolist())

    @property
    def array(self) -> np.ndarray:
        """The entries as an array."""
        return np.array(self.entries, dtype=np.float64)


def _as_tuples(nested: Any) -> Any:
    return tuple(map(_as_tuples, nested)) if isinstance(nested, list) else nested


def value(entry: Constant | Array) -> Array:
    """Return the array of a `Constant`; a traced array is its own."""
    return entry.array if isinstance(entry, Constant) else entry


def namespace(*arrays: Array | np.floating) -> ModuleType:
    """Return NumPy for arrays of known values, jax.numpy where one is traced."""
    return np if all(concrete(array) is not None for array in arrays) else jnp


def number(entry: Any, shape: tuple[int, ...], what: str) -> Float[Array, "..."]:
    """Convert a finite number, or an array of the given shape, to double precision; `what` names it in errors."""
    array = real(entry, what)
    if array.shape != shape:
        expected = "a single number" if shape == () else f"an array of shape {shape}"
        raise ValueError(f"{what} has shape {array.shape}; it must be {expected}")
    return require(array, is_finite, what, "it must be finite")


def number_in(text: str, kind: type[int] | type[float] = float) -> float:
    """Read a number that a file or a command line gives: in ASCII digits, without the underscores that Python takes.

    **Raises:** `ValueError` for what is no number, or none of that kind.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"{text!r} is no number")
    return kind(text)


def is_finite(array: Array | np.floating) -> Any:
    """Tell whether all numbers of an array are finite."""
    known = concrete(array)
    return jnp.isfinite(array).all() if known is None else np.isfinite(known).all()


def real(entry: Any, what: str) -> Float[Array, "..."]:
    """Convert real numbers of any shape to double precision; text, booleans and None are no numbers."""
    return converted(entry, what, _in_double)


def _in_double(entry: Any) -> Array:
    if isinstance(entry, jax.Array):
        return jnp.asarray(entry, dtype=float)
    if any(isinstance(part, jax.Array) for part in jax.tree.leaves(entry)):
        return jnp.stack([jnp.asarray(part, dtype=float) for part in entry])
    return _unchanging(entry, np.dtype(float))


def _unchanging(entry: Any, dtype: np.dtype) -> np.ndarray:
    """A copy that cannot be written to: that of the caller may change."""
    array = np.array(entry, dtype=dtype)
    array.flags.writeable = False
    return array


def read_only(tree: Tree) -> Tree:
    """Replace NumPy arrays that can be written to by copies that cannot, and Python's real numbers by arrays."""
    number = lambda leaf: np.asarray(leaf) if isinstance(leaf, float) else leaf
    fixed = lambda leaf: _unchanging(leaf, leaf.dtype) if can_change(leaf) else leaf
    return jax.tree.map(lambda leaf: fixed(number(leaf)), tree)


def converted(entry: Any, what: str, convert: Callable[[Any], Kind]) -> Kind:
    """Convert an entry by `convert`, where it holds real numbers alone."""
    try:
        if not all(map(_is_real, jax.tree.leaves(entry, is_leaf=lambda part: part is None))):
            raise TypeError("no real number")
        return convert(entry)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(
            f"{what} is {entry!r}; it must be a number or an array of numbers, real ones, none masked"
        ) from error


def _is_real(part: Any) -> bool:
    if np.ma.is_masked(part):
        return False
    if getattr(part, "dtype", np.dtype(object)) == np.dtype(object):
        entries = np.ravel(part).tolist()
        return all(isinstance(entry, numbers.Real) and not isinstance(entry, bool) for entry in entries)
    return jnp.issubdtype(part.dtype, jnp.floating) or jnp.issubdtype(part.dtype, jnp.integer)


MOST = 2**31 - 1  # that counts may be


def whole_number(entry: Any, what: str, least: int = 1, most: int = MOST) -> int:
    """Check an integer from `least` to `most`."""
    if isinstance(entry, bool) or not isinstance(entry, int | np.integer) or not least <= entry <= most:
        raise ValueError(f"{what} is {entry!r}; it must be an integer of at least {least} and at most {most}")
    return int(entry)


def require_bool(entry: Any, what: str) -> bool:
    """Check that an entry is True or False."""
    if not isinstance(entry, bool | np.bool_):
        raise ValueError(f"{what} is {entry!r}; give True or False")
    return bool(entry)


def one_of(entry: Word, choices: tuple[Word, ...], what: str) -> Word:
    """Check that a word is one of several."""
    if not isinstance(entry, str) or entry not in choices:
        raise ValueError(f"{what} is {entry!r}; known: {', '.join(map(repr, choices))}")
    return entry


def require_type(entry: Any, kind: Kinds, what: str, remedy: str) -> Any:
    """Check that an entry is of a kind, or of one of several."""
    if not isinstance(entry, kind):
        raise ValueError(f"{what} is {entry!r}; {remedy}")
    return entry


def listed(entries: Any, kind: Kinds, what: str, remedy: str) -> list[Any]:
    """List entries that are all of a kind, or of one of several."""
    try:
        found = list(entries)
    except TypeError as error:
        raise ValueError(f"{what} is {entries!r}; {remedy}") from error
    return [require_type(entry, kind, f"an entry of {what}", remedy) for entry in found]


def require(array: Array, condition: Callable[[Array], Any], what: str, remedy: str) -> Array:
    """Check that an array meets a condition.

    An array that fails raises a `ValueError` where its values are known. Where they are traced it becomes NaN, which
    the result of a simulation tells.
    """
    met = condition(numbers_of(array))
    if concrete(met) is None:
        return jnp.where(met, array, jnp.nan)
    if not met:
        raise ValueError(f"{what} is {np.asarray(array).tolist()}; {remedy}")
    return array


def numbers_of(array: Array) -> Array:
    """The numbers of an array, without derivatives: NumPy's, but where they are not known."""
    constant = without_derivatives(array)
    return constant if concrete(constant) is None else np.asarray(constant)


def positive(entry: Any, what: str, remedy: str = "it must be positive") -> Scalar:
    """Check a positive number."""
    return require(number(entry, (), what), lambda x: x > 0.0, what, remedy)


def zero_or_more(entry: Any, what: str) -> Scalar:
    """Check a number that is not negative."""
    return require(number(entry, (), what), lambda x: x >= 0.0, what, "it must be zero or more")


def unit_axis(axis: Axis, what: str) -> Constant | Float[Array, "3"]:
    """Make a unit vector from a name ("x", "-z") or numbers, both structure, or from a JAX array, which is traced."""
    if isinstance(axis, str):
        if axis not in COORDINATE_AXES:
            known_axes = ", ".join(COORDINATE_AXES)
            raise ValueError(f"{what} is {axis!r}; known names are {known_axes}, or give a vector")
        return Constant(COORDINATE_AXES[axis])
    remedy = "its length is zero or infinite; give a nonzero vector of finite length"
    vector = require(number(axis, (3,), what), lambda entries: _is_length(_norm(entries)), what, remedy)
    unit = vector / _norm(vector)
    return Constant(unit) if isinstance(vector, np.ndarray) else unit


def _norm(vector: Array) -> Any:
    with np.errstate(over="ignore", under="ignore"):
        return np.linalg.norm(vector) if isinstance(vector, np.ndarray) else jnp.linalg.norm(vector)


def _is_length(length: Any) -> Any:
    return (length > 0.0) & (length < np.inf)


def perpendicular_axes(
    first: Constant | Float[Array, "3"], axis: Axis, what: str
) -> tuple[Constant | Float[Array, "3"], Constant | Float[Array, "3"]]:
    """Make a second unit vector from `axis`, check that it is at a right angle to the first, and return both."""
    second = unit_axis(axis, what)
    one, other = value(first), value(second)
    cosine = concrete(one @ other)
    angle = "" if cosine is None else f", at {np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))):.6g} degrees"
    remedy = f"it must be at a right angle to the first axis{angle}"
    checked = partial(require, condition=lambda _: abs(one @ other) <= 1e-12, what=what, remedy=remedy)
    checked(other)
    mark = lambda unit: unit if isinstance(unit, Constant) else checked(unit)
    return mark(first), mark(second)


def rotation_matrix(rotation: Matrix | None, what: str) -> Constant | Float[Array, "3 3"]:
    """Check a rotation matrix. None (no rotation) and numbers are structure, a JAX array is traced."""
    if rotation is None:
        return Constant(np.eye(3))
    remedy = "its columns must be the orthonormal, right-handed axes of the frame"
    matrix = require(number(rotation, (3, 3), what), _is_rotation, what, remedy)
    return Constant(matrix) if isinstance(matrix, np.ndarray) else matrix


def _is_rotation(matrix: Array) -> Any:
    xp = namespace(matrix)
    return xp.allclose(matrix @ matrix.T, np.eye(3), atol=1e-9) & (xp.linalg.det(matrix) > 0.0)
