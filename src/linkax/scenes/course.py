"""A smooth change of a coordinate, which several scenes share."""

import equinox as eqx
import jax.numpy as jnp

from linkax.model.numbers import Number
from linkax.xla.arrays import Scalar


class Course(eqx.Module):
    """A smooth change from one value to another in a time [s], by a polynomial of fifth degree."""

    begin: Scalar
    end: Scalar
    duration: Scalar

    def __call__(self, t: Number) -> Scalar:
        s = jnp.clip(t / self.duration, 0.0, 1.0)
        return self.begin + (self.end - self.begin) * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
