"""The one dial between speed and accuracy."""

from typing import Literal, get_args

import equinox as eqx

from linkax.formulations.tangent_space import Metric, TangentSpace
from linkax.model.numbers import Number, number, one_of, require
from linkax.xla.arrays import Scalar
from linkax.xla.users_line import warn

Projection = Literal["both", "stage", "step", "none"]


class Accuracy(eqx.Module):
    """How accurately to integrate, and how to keep the loops closed.

    **Arguments:**

    - `rtol`: tolerance of one step for speeds, relative to the largest speed in the mechanism.
    - `atol`: tolerance of one step for coordinates, in radians and in lengths of the mechanism,
      and the floor of the tolerance for speeds. Default: `rtol`.
    - `projection`: where the state is put back on the closed loops: in every evaluation of the
      equations of motion ("stage"), after every accepted step ("step"), "both" (default), or
      "none". Saved states are corrected always. (For a classical formulation see there.)
    - `clearance`: distance d from a singular configuration that the stages of adaptive steps keep
      where they can, by placing a passage between two of them; 0: no step is placed. d is the
      smallest over the largest diagonal of R, of the order of the distance itself in radians or
      lengths of the mechanism.
    - `rank_tolerance`, `metric`: deprecated, give `formulation=linkax.TangentSpace(rank_tolerance, metric=...)`.

    **Raises:** `ValueError` for a tolerance that is not a positive number of at most 1.
    """

    rtol: Scalar
    atol: Scalar
    clearance: Scalar
    projection: Projection = eqx.field(static=True)
    rank_tolerance: Scalar | None
    metric: Metric | None = eqx.field(static=True)

    def __init__(
        self,
        rtol: Number = 1e-8,
        atol: Number | None = None,
        *,
        projection: Projection = "both",
        rank_tolerance: Number | None = None,
        clearance: Number = 1e-2,
        metric: Metric | None = None,
    ) -> None:
        self.rtol = _number("rtol", rtol)
        self.atol = self.rtol if atol is None else _number("atol", atol)
        self.clearance = _number("clearance", clearance, zero=True)
        self.projection = one_of(projection, get_args(Projection), "projection")
        self.rank_tolerance = self.metric = None
        if rank_tolerance is not None or metric is not None:
            given = TangentSpace(rank_tolerance, metric="mass" if metric is None else metric)
            self.rank_tolerance, self.metric = given.rank_tolerance, given.metric
            warn(
                "rank_tolerance and metric of linkax.Accuracy are deprecated; give "
                "formulation=linkax.TangentSpace(rank_tolerance, metric=...) to linkax.simulate",
                DeprecationWarning,
            )

    @property
    def tangent_space(self) -> TangentSpace | None:
        """The formulation that `rank_tolerance` and `metric` ask for; None where neither is given."""
        return None if self.metric is None else TangentSpace(self.rank_tolerance, metric=self.metric)


def _number(name, value, zero=False):
    kind = "zero or more" if zero else "positive"
    right = lambda x: ((x > 0.0) | (zero & (x == 0.0))) & (x <= 1.0)
    return require(number(value, (), name), right, name, f"it must be {kind}, and at most 1, such as 1e-8")


# Measured by `python -m benchmarks.work_precision --vary nothing`: the largest error over 10 s on eleven problems, of
# size one metre, and the time of a run, compiled, relative to BALANCED. The README has all of them.
DRAFT = Accuracy(rtol=1e-4)
"""For a first look: errors of 1e-4 to 1e-2 m, 0.4 to 1 times the cost of `BALANCED`."""

BALANCED = Accuracy(rtol=1e-8)
"""The default: errors of 4e-8 to 2e-6 m. Where `linkax.Solution.error_estimate` tells of more than you allow, take
`PRECISE`, or a tolerance between them."""

PRECISE = Accuracy(rtol=1e-12)
"""For reference answers and derivatives: errors of 2e-11 to 2e-9 m, 1.1 to 2.3 times the cost of `BALANCED`."""
