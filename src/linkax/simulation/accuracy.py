"""The one dial between speed and accuracy."""

from typing import Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from linkax.formulations.tangent_space import TangentSpace
from linkax.model.numbers import number, one_of, require

Projection = Literal["both", "stage", "step", "none"]
Metric = Literal["mass", "identity"]


class Accuracy(eqx.Module):
    """How accurately to integrate, and how to keep the loops closed.

    **Arguments:**

    - `rtol`: tolerance of one step for speeds, relative to the largest speed in the mechanism.
    - `atol`: tolerance of one step for coordinates, in radians and in lengths of the mechanism,
      and the floor of the tolerance for speeds. Default: `rtol`.
    - `projection`: where the state is put back on the closed loops: in every evaluation of the
      equations of motion ("stage"), after every accepted step ("step"), "both" (default), or
      "none". Saved states are corrected always. (For a classical formulation see there.)
    - `rank_tolerance`: τ; a loop row counts as independent where |R_kk| > τ max(|R₁₁|, 1).
      Default: 1e-6 in double, 1e-5 in single precision.
    - `clearance`: distance d from a singular configuration that the stages of adaptive steps keep
      where they can, by placing a passage between two of them; 0: no step is placed. d is the
      smallest over the largest diagonal of R, of the order of the distance itself in radians or
      lengths of the mechanism.
    - `metric`: "mass" (default) or "identity", see `linkax.TangentSpace`.

    **Raises:** `ValueError` for a tolerance that is not a positive number of at most 1.
    """

    rtol: np.ndarray
    atol: np.ndarray
    rank_tolerance: np.ndarray | None
    clearance: np.ndarray
    projection: Projection = eqx.field(static=True)
    metric: Metric = eqx.field(static=True)

    def __init__(self, rtol=1e-8, atol=None, *, projection="both", rank_tolerance=None, clearance=1e-2, metric="mass"):
        self.rtol = _number("rtol", rtol)
        self.atol = self.rtol if atol is None else _number("atol", atol)
        self.rank_tolerance = None if rank_tolerance is None else _number("rank_tolerance", rank_tolerance)
        self.clearance = _number("clearance", clearance, zero=True)
        self.projection = one_of(projection, get_args(Projection), "projection")
        self.metric = one_of(metric, get_args(Metric), "metric")

    def method(self, dtype, rank_nearby=None) -> TangentSpace:
        """The paper's method at this accuracy, for numbers of the given type."""
        double = np.finfo(dtype).bits == 64
        either = lambda number, default: jnp.asarray(default if number is None else number, dtype)
        return TangentSpace(
            either(self.rank_tolerance, 1e-6 if double else 1e-5),
            rank_nearby,
            metric=self.metric,
        )


def _number(name, value, zero=False):
    kind = "zero or more" if zero else "positive"
    right = lambda x: ((x > 0.0) | (zero & (x == 0.0))) & (x <= 1.0)
    return require(number(value, (), name), right, name, f"it must be {kind}, and at most 1, such as 1e-8")


# Measured by `python -m benchmarks.work_precision --vary nothing`: the largest error over 10 s on eleven problems, of
# size one metre, and the time of a run, compiled, relative to BALANCED. The README has all of them.
DRAFT = Accuracy(rtol=1e-4)
"""For a first look: errors of 1e-4 to 1e-2 m, 0.4 to 1 times the cost of `BALANCED`."""

BALANCED = Accuracy(rtol=1e-8)
"""The default: errors of 6e-8 to 2e-6 m. Where `linkax.Solution.error_estimate` tells of more than you allow, take
`PRECISE`, or a tolerance between them."""

PRECISE = Accuracy(rtol=1e-12)
"""For reference answers and derivatives: errors of 2e-11 to 2e-9 m, 1.1 to 2.3 times the cost of `BALANCED`."""
