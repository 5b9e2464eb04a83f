"""Estimate the uncertainty of fitted parameters."""

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float, Int

from linkax.studies.parameters.free_parameters import FreeParameters
from linkax.xla.arrays import Array
from linkax.xla.tracing import jit_inline

NO_INFLUENCE = 1e-10  # sensitivity of a parameter, relative to the largest, up to which it has no influence
DEPENDENT = 1e-8  # diagonal entry of R, relative to the largest, up to which it is rounding of the derivatives
INVOLVED = 1e-3  # part of a parameter in a change that the data do not see, up to which it is not involved

MOST_TRIALS = 1000  # of draws within bounds


class Spread(NamedTuple):
    """How far from a fit parameters may be; a function: level of confidence -> ends of the intervals.

    - `free`, `z`: the parameters as functions of free numbers, and these as fitted, (p,).
    - `covariance`: of the numbers, (n, n). `of_free`: of the free numbers, (p, p); zero where the data do not determine
      them. `deviation`: their standard deviations, (p,), infinite there. `unscaled`: what `of_free` were if all rows of
      the residual had variance one.
    - `noise`: standard deviation of the residual. `freedom`: its degrees of freedom.
    - `sides`: -1 or 1 for a free number on its lower or upper bound, else 0, (p,). `of_free` is zero for one on a
      bound; its `deviation` is what it would be without, when others stay on theirs, and `beyond` how far beyond the
      bound its best value would then be, (p,).
    """

    free: FreeParameters
    z: Float[Array, " p"]
    covariance: Float[np.ndarray, "n n"]
    of_free: Float[np.ndarray, "p p"]
    deviation: Float[np.ndarray, " p"]
    unscaled: Float[np.ndarray, "p p"]
    noise: float
    freedom: float
    sides: Int[np.ndarray, " p"]
    beyond: Float[np.ndarray, " p"]

    def quantile(self, level: float) -> float:
        """How many standard deviations an interval reaches to each side, by Student's t distribution."""
        from scipy.stats import t as student  # SciPy takes its time

        return float(student.ppf(0.5 + level / 2.0, self.freedom))

    def half_width(self, level: float) -> Float[np.ndarray, " p"]:
        """How far an interval of the likelihood reaches to each side, in free numbers; from a bound, to the inner."""
        return np.sqrt((self.quantile(level) * self.deviation) ** 2 + self.beyond**2) - self.beyond

    def __call__(self, level: float) -> tuple[Any, Any]:
        best, unravel = np.asarray(self.free.vector(self.z)), ravel_pytree(self.free.params(self.z))[1]
        times, half, bounds = self.quantile(level), self.half_width(level), self.free.bounds
        rates = np.asarray(jax.jacfwd(self.free.vector)(self.z))
        ends = []
        for sign, bound in zip((-1.0, 1.0), bounds, strict=True):
            linear = best + sign * times * np.sqrt(np.diagonal(self.covariance))
            moved = np.asarray(self.free.vector(self.z + sign * half))
            # From a bound the number itself is taken as linear: a logarithm would lead nowhere.
            inner = np.clip(best + sign * rates @ np.where(self.sides == 0, 0.0, half), *bounds)
            side = np.sum(np.where(rates != 0.0, self.sides, 0), axis=1)
            from_bound = np.where(side == sign, bound, inner)
            end = np.where(self.free.apart, np.where(side == 0, moved, from_bound), linear)
            ends.append(jax.tree.map(np.asarray, unravel(jnp.asarray(end))))
        return tuple(ends)

    def draws(self, key: Array, count: int) -> Any:
        """Parameters from the normal distribution of the free numbers within their ends, `count` along the first axis.

        **Raises:** `ValueError` where hardly any are within the ends.
        """
        deviation = np.sqrt(np.diagonal(self.of_free))
        size = np.where(deviation > 0.0, deviation, 1.0)  # zero where the fit is exact, and on a bound
        scaled = self.of_free / np.outer(size, size)
        values, vectors = np.linalg.eigh(scaled)
        root = deviation[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
        (lower, upper), kept = map(np.asarray, self.free.ends), []
        for trial in range(MOST_TRIALS):
            normal = jax.random.normal(jax.random.fold_in(key, trial), (count, len(self.z)))
            drawn = np.asarray(self.z) + np.asarray(normal) @ root.T
            kept = [*kept, *drawn[np.all((drawn >= lower) & (drawn <= upper), axis=1)]][:count]
            if len(kept) == count:
                return jax.tree.map(np.asarray, jax.vmap(self.free.params)(jnp.asarray(kept)))
        raise ValueError(
            f"of {MOST_TRIALS * count} draws {len(kept)} are within the bounds; measure more, or sample the posterior"
        )


class Uncertainty(NamedTuple):
    """Covariance of all parameters, and the names of those that the data do not determine.

    - `covariance`, `noise`, `undetermined`: see `linkax.Fit`.
    - `spread`: level of confidence -> (lower, upper) ends of the intervals, in the structure of the parameters; draws.
    """

    covariance: Float[np.ndarray, "n n"]
    noise: float
    undetermined: list[str]
    spread: Spread


class Scatter(NamedTuple):
    """How much measurements scatter.

    - `noise`: standard deviation of the residual. `variances`: of its rows, (n,).
    """

    noise: float
    variances: Float[np.ndarray, " n"]


class _Triangle(NamedTuple):
    """Column-pivoted QR of sensitivities, in units of their columns.

    - `r`: the triangle. `order`: of the columns in it. `rank`: how many of these are independent.
    - `scale`: units of the columns, in the order of the free numbers.
    """

    r: Float[np.ndarray, "p p"]
    order: np.ndarray
    rank: int
    scale: Float[np.ndarray, " p"]

    @staticmethod
    def of(slopes: Float[np.ndarray, "n p"]) -> "_Triangle":
        if not slopes.size:
            return _Triangle(np.zeros((0, 0)), np.zeros(0, int), 0, np.zeros(0))
        norms = np.linalg.norm(slopes, axis=0)
        matters = norms > NO_INFLUENCE * np.max(norms, initial=0.0)
        scale = np.where(matters, norms, 1.0)
        from scipy import linalg  # takes its time to import

        scaled = np.where(matters, slopes / scale, 0.0)
        r, order = cast(Any, linalg.qr(scaled, mode="r", pivoting=True, check_finite=False))
        r = r[: len(order)]
        diagonal = np.abs(np.diagonal(r))
        rank = int(np.sum(diagonal > DEPENDENT * max(diagonal[0], np.finfo(float).tiny)))
        return _Triangle(r, order, rank, scale)

    @property
    def inverse(self) -> Float[np.ndarray, "r r"]:
        """Of the independent columns."""
        return np.linalg.inv(self.r[: self.rank, : self.rank]) if self.rank else np.zeros((0, 0))


def leverages(slopes: Float[np.ndarray, "n p"]) -> Float[np.ndarray, " n"]:
    """How many fitted numbers each row of a residual determines: the diagonal of J (Jᵀ J)⁺ Jᵀ, with J the slopes, (n,).

    Rows of priors count as others do: what they determine, measurements do not.
    """
    triangle = _Triangle.of(slopes)
    columns = triangle.order[: triangle.rank]
    return np.sum((slopes[:, columns] / triangle.scale[columns] @ triangle.inverse) ** 2, axis=1)


@jit_inline
def _slopes_of_params(free, z):
    return jax.jacfwd(free.vector)(z)


def uncertainty(
    residual: Float[np.ndarray, " n"],
    slopes: Float[np.ndarray, "n p"],
    free: FreeParameters,
    z: Float[Array, " p"],
    scatter: Scatter | None = None,
    pulls: Float[np.ndarray, " p"] | None = None,
) -> Uncertainty:
    """Estimate the covariance of the parameters at z, by column-pivoted QR of the residual's sensitivities `slopes`.

    The last rows are those of priors, which have variance one.

    **Arguments:** `scatter`: of the other rows; by default all have one noise, which is estimated. `pulls`: minus the
    gradient of the loss by free numbers that are on a bound, else zero; these are taken as known for the others.
    """
    count, size = len(slopes) - free.num_priors, slopes.shape[1]
    pulls = np.zeros(size) if pulls is None else pulls
    sides = np.sign(pulls).astype(int)
    inside, scale = np.flatnonzero(sides == 0), np.ones(size)
    r, order, rank, scale[inside] = triangle = _Triangle.of(slopes[:, inside])
    order, to_free, inverse = inside[order], np.zeros((size, size)), triangle.inverse
    rows = order[:rank]
    to_free[np.ix_(rows, rows)] = inverse @ inverse.T / np.outer(scale[rows], scale[rows])
    gain = to_free @ slopes.T
    # What is left of the measurements when they have determined what priors leave to them.
    freedom = max(count - float(np.sum(gain.T[:count] * slopes[:count])), 1.0)
    if scatter is None:
        noise = float(np.sqrt(residual[:count] @ residual[:count] / freedom))
        scatter = Scatter(noise, np.full(count, noise**2))
    variances = np.concatenate([scatter.variances, np.ones(len(slopes) - count)])
    of_free = gain * variances @ gain.T
    # Changes that the residual does not see: of one dependent parameter, and of those that make up for it.
    unseen = np.zeros((size, len(order) - rank))
    unseen[order[:rank]] = -inverse @ r[:rank, rank:]
    unseen[order[rank:]] = np.eye(len(order) - rank)
    lost = np.any(np.abs(unseen) > INVOLVED, axis=1)
    slopes_of_params = np.asarray(_slopes_of_params(free, z))
    covariance = slopes_of_params @ of_free @ slopes_of_params.T
    undetermined = _undetermined(slopes_of_params, unseen, scale)
    covariance[undetermined, undetermined] = np.inf
    deviation, beyond = np.sqrt(np.where(lost, np.inf, np.diagonal(of_free))), np.zeros(size)
    for entry in np.flatnonzero(sides):
        own, others = slopes[:, entry], slopes[:, rows] / scale[rows]
        own = own - others @ np.linalg.lstsq(others, own, rcond=DEPENDENT)[0]
        curvature = max(own @ own, np.finfo(float).tiny)
        deviation[entry], beyond[entry] = scatter.noise / np.sqrt(curvature), abs(pulls[entry]) / curvature
    on_bound = free.apart & np.any((slopes_of_params != 0.0) & (sides != 0), axis=1)
    covariance[on_bound], covariance[:, on_bound] = np.nan, np.nan
    names = [name for name, is_lost in zip(free.names, undetermined, strict=True) if is_lost]
    spread = Spread(free, z, covariance, of_free, deviation, to_free, scatter.noise, freedom, sides, beyond)
    return Uncertainty(covariance, scatter.noise, names, spread)


def _undetermined(slopes_of_params, unseen, scale):
    """Which numbers depend on free numbers that are not determined, whose changes do not cancel."""
    depends = np.abs(slopes_of_params)
    depends = np.where(depends > NO_INFLUENCE * np.max(depends, axis=1, keepdims=True), slopes_of_params, 0.0)
    each = np.abs(depends) @ np.where(np.abs(unseen) > INVOLVED, np.abs(unseen) / scale[:, None], 0.0)
    together = np.abs(depends @ (unseen / scale[:, None]))
    return np.any((each > 0.0) & (together > INVOLVED * each), axis=1)
