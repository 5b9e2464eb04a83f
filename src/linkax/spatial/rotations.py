"""Rotations as 3 × 3 matrices, whose columns are the rotated axes."""

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
    """Rotate vectors v (..., 3) by rotations R (..., 3, 3): R v."""
    return jnp.sum(rotation * vector[..., None, :], axis=-1)


def compose(first: Float[Array, "*#batch l m"], second: Float[Array, "*#batch m n"]) -> Float[jax.Array, "... l n"]:
    """Multiply rotations (..., 3, 3), or other matrices; `second` acts on a vector first."""
    return jnp.sum(first[..., :, :, None] * second[..., None, :, :], axis=-2)


def transpose(rotation: Float[Array, "*batch 3 3"]) -> Float[jax.Array, "*batch 3 3"]:
    """Invert a rotation R, shape (..., 3, 3): Rᵀ."""
    return jnp.swapaxes(rotation, -1, -2)


def rotation_about_first_axis(angle: Scalar) -> Float[jax.Array, "3 3"]:
    """Make the rotation by `angle` [rad] about the first axis."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    return jnp.stack([one, zero, zero, zero, c, -s, zero, s, c]).reshape(3, 3)


def angle_about_first_axis(rotation: Float[Array, "3 3"]) -> Float[jax.Array, ""]:
    """Read the angle [rad], in (−π, π], of a rotation (3, 3) about the first axis."""
    return jnp.arctan2(rotation[2, 1], rotation[1, 1])


def frame_about_axis(axis: Float[Array, "3"], second: Float[Array, "3"] | None = None) -> Float[Array, "3 3"]:
    """Make a right-handed frame, shape (3, 3), whose first axis is the unit vector `axis`.

    Its second axis is `second`, a unit vector at a right angle to it, or e × axis, normalised, where e comes
    before the coordinate axis nearest to `axis` in cyclic order; so coordinate axes give coordinate frames.
    NumPy's arrays give NumPy's.
    """
    xp = np if isinstance(axis, np.ndarray) and isinstance(second, np.ndarray | None) else jnp
    if second is None:
        helper = xp.eye(3)[(xp.argmax(xp.abs(axis)) + 2) % 3]
        second = xp.cross(helper, axis)
        second = second / xp.sqrt(xp.sum(second * second))
    return xp.stack([axis, second, xp.cross(axis, second)], axis=-1)
