"""Rotations as 3x3 matrices whose columns are the rotated axes."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.xla.arrays import Array, Scalar

COORDINATE_AXES = {
    sign + name: (1.0 if sign == "" else -1.0) * np.eye(3)[index]
    for index, name in enumerate("xyz")
    for sign in ("", "-")
}


def rotate(rotation: Float[Array, "*#batch 3 3"], vector: Float[Array, "*#batch 3"]) -> Float[jax.Array, "... 3"]:
    """Rotate vectors (..., 3) by rotations (..., 3, 3)."""
    return jnp.sum(rotation * vector[..., None, :], axis=-1)


def compose(first: Float[Array, "*#batch l m"], second: Float[Array, "*#batch m n"]) -> Float[jax.Array, "... l n"]:
    """Product of rotations (..., 3, 3), or of other matrices: `second` is applied first to a vector."""
    return jnp.sum(first[..., :, :, None] * second[..., None, :, :], axis=-2)


def transpose(rotation: Float[Array, "*batch 3 3"]) -> Float[jax.Array, "*batch 3 3"]:
    """Inverse of a rotation, shape (..., 3, 3)."""
    return jnp.swapaxes(rotation, -1, -2)


def rotation_about_first_axis(angle: Scalar) -> Float[jax.Array, "3 3"]:
    """Rotation by `angle` [rad] about the first axis."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    return jnp.stack([one, zero, zero, zero, c, -s, zero, s, c]).reshape(3, 3)


def angle_about_first_axis(rotation: Float[Array, "3 3"]) -> Float[jax.Array, ""]:
    """The angle [rad] in (−π, π] of a rotation (3, 3) about the first axis."""
    return jnp.arctan2(rotation[2, 1], rotation[1, 1])


def frame_about_axis(axis: Float[Array, "3"], second: Float[Array, "3"] | None = None) -> Float[Array, "3 3"]:
    """A right-handed frame whose first axis is the unit vector `axis`, shape (3, 3).

    The second axis is given, a unit vector at a right angle, or is the normalised product of the
    coordinate axis that is farthest from `axis` (in cyclic order) with it, so coordinate axes give
    coordinate frames. NumPy in gives NumPy out.
    """
    xp = np if isinstance(axis, np.ndarray) and isinstance(second, np.ndarray | None) else jnp
    if second is None:
        helper = xp.eye(3)[(xp.argmax(xp.abs(axis)) + 2) % 3]
        second = xp.cross(helper, axis)
        second = second / xp.sqrt(xp.sum(second * second))
    return xp.stack([axis, second, xp.cross(axis, second)], axis=-1)
