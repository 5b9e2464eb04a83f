"""Estimate the uncertainty of fitted parameters."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from linkax.linalg.pivoted_qr import pivoted_qr
from linkax.studies.free_parameters import FreeParameters
from linkax.xla.arrays import Array

NO_INFLUENCE = 1e-10  # sensitivity of a parameter, relative to the largest, up to which it has no influence
DEPENDENT = 1e-8  # diagonal entry of R, relative to the largest, up to which it is rounding of the derivatives
INVOLVED = 1e-3  # part of a parameter in a change that the data do not see, up to which it is not involved


class Uncertainty(NamedTuple):
    """Covariance of all parameters, and the names of those that the data do not determine.

    - `covariance`, `noise`, `undetermined`: see `linkax.Fit`.
    - `spread`: level of confidence -> (lower, upper) ends of the intervals, in the structure of the parameters.
    """

    covariance: Float[np.ndarray, "n n"]
    noise: float
    undetermined: list[str]
    spread: Callable[[float], tuple[Any, Any]]


class Scatter(NamedTuple):
    """How much measurements scatter.

    - `noise`: standard deviation of the residual. `variances`: of its rows, (n,).
    """

    noise: float
    variances: Float[np.ndarray, " n"]


def uncertainty(
    residual: Float[np.ndarray, " n"],
    slopes: Float[np.ndarray, "n p"],
    free: FreeParameters,
    z: Float[Array, " p"],
    scatter: Scatter | None = None,
) -> Uncertainty:
    """Estimate the covariance of the parameters at z, by column-pivoted QR of the residual's sensitivities `slopes`.

    The last rows are those of priors, which have variance one.

    **Arguments:** `scatter`: of the other rows; by default all have one noise, which is estimated.
    """
    count, size = len(slopes) - free.num_priors, slopes.shape[1]
    norms = np.linalg.norm(slopes, axis=0)
    matters = norms > NO_INFLUENCE * np.max(norms, initial=0.0)
    scale = np.where(matters, norms, 1.0)
    square = np.linalg.qr(np.where(matters, slopes / scale, 0.0), mode="r")
    _, r, order = (np.asarray(part) for part in pivoted_qr(jnp.asarray(square)))
    diagonal = np.abs(np.diagonal(r))
    rank = int(np.sum(diagonal > DEPENDENT * max(diagonal[0], np.finfo(float).tiny)))
    to_free = np.zeros((size, size))
    inverse = np.linalg.inv(r[:rank, :rank]) if rank else np.zeros((0, 0))
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
    unseen = np.zeros((size, size - rank))
    unseen[order[:rank]] = -inverse @ r[:rank, rank:]
    unseen[order[rank:]] = np.eye(size - rank)
    lost = np.any(np.abs(unseen) > INVOLVED, axis=1)
    slopes_of_params = np.asarray(jax.jacfwd(free.vector)(z))
    covariance = slopes_of_params @ of_free @ slopes_of_params.T
    depends = np.abs(slopes_of_params)
    depends = np.where(depends > NO_INFLUENCE * np.max(depends, axis=1, keepdims=True), slopes_of_params, 0.0)
    # A number is undetermined where the free numbers that it depends on are, and their changes do not cancel.
    each = np.abs(depends) @ np.where(np.abs(unseen) > INVOLVED, np.abs(unseen) / scale[:, None], 0.0)
    together = np.abs(depends @ (unseen / scale[:, None]))
    undetermined = np.any((each > 0.0) & (together > INVOLVED * each), axis=1)
    covariance[undetermined, undetermined] = np.inf
    deviation = np.sqrt(np.where(lost, np.inf, np.diagonal(of_free)))
    names = [name for name, is_lost in zip(free.names, undetermined, strict=True) if is_lost]
    return Uncertainty(covariance, scatter.noise, names, partial(_ends, free, z, covariance, deviation, freedom))


def _ends(free, z, covariance, deviation, freedom, level):
    """(lower, upper) ends of the intervals, from Student's t distribution."""
    from scipy.stats import t as student  # SciPy takes its time

    _, unravel = ravel_pytree(free.params(z))
    times, ends = float(student.ppf(0.5 + level / 2.0, freedom)), []
    for sign in (-1.0, 1.0):
        linear = np.asarray(free.vector(z)) + sign * times * np.sqrt(np.diagonal(covariance))
        moved = np.asarray(free.vector(z + sign * times * deviation))
        ends.append(jax.tree.map(np.asarray, unravel(jnp.asarray(np.where(free.apart, moved, linear)))))
    return tuple(ends)
