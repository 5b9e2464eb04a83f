"""The classical Runge-Kutta method, which diffrax does not have."""

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import numpy as np


class RungeKutta4(diffrax.AbstractERK):
    """The classical method of order four, for fixed steps: it estimates no error.

    Kutta, Zeitschrift für Mathematik und Physik 46, 1901.
    """

    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
        b_error=np.zeros(4),
        c=np.array([0.5, 0.5, 1.0]),
    )
    interpolation_cls: ClassVar[Callable] = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms: Any) -> int:
        return 4

    def step(self, *arguments: Any) -> tuple[Any, None, Any, Any, diffrax.RESULTS]:
        y1, _, dense_info, state, result = super().step(*arguments)
        return y1, None, dense_info, state, result
