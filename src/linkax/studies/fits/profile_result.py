"""The profile of a likelihood, and its intervals."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from linkax.tables import Rows, Table, count, numbers, one, printed_as


def _table(found: "Profile") -> Table:
    title = f"Profile of {found.name}: {count(len(found.values), 'value')}, {one(found.best)} fits best"
    mark = lambda converged: "" if converged else "not refitted"
    columns = zip(found.values, found.losses, found.roots, map(mark, found.converged), strict=True)
    rows = [(numbers(value), numbers(loss), numbers(root), remark) for value, loss, root, remark in columns]
    told = lambda end: one(end) + " (bound)" * (np.isfinite(end) and end in found.bounds)
    ends = [(f"{level:.0%}", *map(told, found.interval(level))) for level in (0.68, 0.95)]
    intervals = Rows(("interval", "from", "to"), ends)
    return Table(title, [intervals, Rows((found.name, "loss", "signed root", ""), rows, "values")])


@printed_as(_table)
class Profile(NamedTuple):
    """Fits of all other parameters at n values of one.

    - `name`: of the number. `best`: its value in the fit. `values`: in rising order, (n,).
    - `losses`: half the sum of squares of each refit, (n,). `loss`: that of the fit.
    - `params`: of each refit, in the structure of `Fit.params` with a leading axis.
    - `converged`: whether each refit did, (n,); others count for nothing.
    - `bounds`: lower and upper bound of the number, where `values` reach it, else minus and plus infinity.
    - `noise`: of the residual, for this number: its standard error over what the curvature of the loss makes it for
      noise of one; without priors and robust losses, the standard deviation. `freedom`: its degrees of freedom.
    """

    name: str
    best: float
    values: Float[np.ndarray, " n"]
    losses: Float[np.ndarray, " n"]
    params: Any
    converged: Bool[np.ndarray, " n"]
    loss: float
    noise: float
    freedom: float
    bounds: tuple[float, float] = (-np.inf, np.inf)

    @property
    def roots(self) -> Float[np.ndarray, " n"]:
        """Signed roots ± √(2 (losses − loss)) / noise, (n,): a straight line in `values` where the fit is linear."""
        rise = np.sqrt(2.0 * np.maximum(self.losses - self.loss, 0.0)) / self.noise
        return np.where(self.converged, np.sign(self.values - self.best) * rise, np.nan)

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Lower and upper end of the interval of the likelihood ratio.

        Where the square of the root is the quantile of F(1, freedom), interpolated. Where the values do not reach as
        far, it is the bound, if they reach that, and else infinite.

        **Raises:** `ValueError` for a level that is not between 0 and 1.
        """
        from scipy.stats import t as student  # SciPy takes its time

        if not 0.0 < level < 1.0:
            raise ValueError(f"level is {level!r}; it must lie between 0 and 1, such as 0.95")
        quantile = float(student.ppf(0.5 + level / 2.0, self.freedom))
        return self._end(-quantile), self._end(quantile)

    def _end(self, root):
        """Where the profile first reaches a root on its side of the fit."""
        from scipy.interpolate import PchipInterpolator

        side = np.sign(root)
        chosen = self.converged & (side * (self.values - self.best) > 0.0)
        distances = side * (self.values[chosen] - self.best)
        order = np.argsort(distances)
        distances, roots = distances[order], np.abs(self.roots[chosen][order])
        beyond = np.flatnonzero(roots >= abs(root))
        if not len(beyond):
            return self.bounds[int(side > 0.0)]
        last = beyond[0] + 1
        curve = PchipInterpolator([0.0, *distances[:last]], np.maximum.accumulate([0.0, *roots[:last]]))
        return float(self.best + side * curve.solve(abs(root), extrapolate=False)[0])
