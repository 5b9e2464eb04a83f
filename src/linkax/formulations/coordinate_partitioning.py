"""Generalised coordinate partitioning as a correction."""

from jaxtyping import Float

from linkax.formulations.classical import AbstractCorrection, parameter
from linkax.linalg.right_inverse import by_partition
from linkax.model.numbers import Number
from linkax.xla.arrays import Array


class CoordinatePartitioning(AbstractCorrection):
    """Dependent coordinates and speeds follow the independent ones.

    Which are which, elimination with complete pivoting decides, anew at each state that is corrected. After Wehage
    and Haug, Journal of Mechanical Design 104, 1982, who keep a choice as long as it is well conditioned.

    - `tolerance`: a pivot below that much of the first one is none; its row is left out.
    """

    tolerance: Number = parameter(1e-6, "tolerance of CoordinatePartitioning")

    def right_inverse(self, mass: Float[Array, "n n"], jacobian: Float[Array, "m n"]) -> Float[Array, "n m"]:
        return by_partition(jacobian, self.tolerance)
