"""Numbers of a model: which are traced, which are structure, and how they are checked.

Values that are known when a model is built are validated there. Values under a JAX
transformation are not known; they are passed on, and a bad one shows in the solution's result.
"""

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


def all_known(tree) -> bool:
    """Whether no array of a tree is traced."""
    return all(known(leaf) is not None for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array)))


def number(entry, shape: tuple[int, ...], what: str):
    """A traced leaf of the given shape in double precision; `what` names it in errors."""
    try:
        if isinstance(entry, jax.Array):
            array = jnp.asarray(entry, dtype=float)
        elif any(isinstance(part, jax.Array) for part in jax.tree.leaves(entry)):
            array = jnp.stack([jnp.asarray(part, dtype=float) for part in entry])
        else:
            array = np.asarray(entry, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} is {entry!r}; it must be a number or an array of numbers") from error
    if array.shape != shape:
        expected = "a single number" if shape == () else f"an array of shape {shape}"
        raise ValueError(f"{what} has shape {array.shape}; it must be {expected}")
    concrete = known(array)
    if concrete is not None and not np.all(np.isfinite(concrete)):
        raise ValueError(f"{what} is {concrete.tolist()}; it must be finite")
    return array


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
    length = np.linalg.norm(vector) if isinstance(vector, np.ndarray) else jnp.linalg.norm(vector)
    require(length, lambda size: size > 0.0, f"{what} has zero length: its norm", "give a nonzero vector")
    return Constant(vector / length) if isinstance(vector, np.ndarray) else vector / length


def perpendicular_axis(axis, first, what: str):
    """A unit vector like `unit_axis`, checked to be at a right angle to another."""
    second = unit_axis(axis, what)
    if isinstance(second, Constant) and isinstance(first, Constant):
        cosine = float(second.array @ first.array)
        if abs(cosine) > 1e-12:
            raise ValueError(
                f"{what} is {second.array.tolist()}, at {np.degrees(np.arccos(cosine)):.6g} degrees to the first axis "
                f"{first.array.tolist()}; it must be at a right angle to it"
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
