"""Least changes of coordinates and speeds that satisfy linear equations, with beams strained as little as possible."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Float, Int

from linkax.equations.system import System
from linkax.formulations.tangent_space import TangentSpace
from linkax.linalg.constrained_solve import constrained_solve
from linkax.linalg.saddle_inverse import invert
from linkax.model.beams import BeamElasticity
from linkax.xla.arrays import Array, Scalar
from linkax.xla.static_scatter import scatter_static


def rank_tolerance(dtype: np.dtype) -> Float[Array, ""]:
    """τ of everything that is assembled."""
    return TangentSpace().prepared(dtype).tolerance


def beams_of(system: System) -> list[BeamElasticity]:
    """The elastic forces of beams."""
    return [force for force in system.forces if isinstance(force, BeamElasticity)]


def strains_of(system: System) -> Int[np.ndarray, " n_s"]:
    """Indices of the strains of beams among the speeds."""
    taken = [system.topology.speeds[beam.beam] for beam in beams_of(system)]
    return np.concatenate([np.zeros(0, int), *(np.arange(of.start, of.stop) for of in taken)])


def elastic_energy(system: System) -> Float[Array, "n_s n_s"]:
    """The matrix of twice the energy of strains."""
    return block_diag(*(beam.matrix for beam in beams_of(system)))


def nearest_solution(
    system: System,
    x: Float[Array, " n_v"],
    slopes: Float[Array, "m n_v"],
    right: Float[Array, " m"],
    tolerance: Scalar | None = None,
) -> Float[Array, " n_v"]:
    """Solve slopes @ y = right for the y nearest to x, in radians and lengths of the mechanism.

    Strains of beams differ from x only in what all else leaves open, by as little energy as they can.

    **Arguments:** `tolerance`: for independent rows, by default `rank_tolerance`.
    """
    strains, scales = strains_of(system), system.scales
    if not len(strains):
        return nearest_solution_in(None, scales, x, slopes, right, tolerance)
    others = np.setdiff1d(np.arange(len(scales)), strains)
    of_others = lambda x, right: nearest_solution_in(None, scales[others], x, slopes[:, others], right, tolerance)
    left = lambda right: right - slopes[:, others] @ of_others(jnp.zeros_like(x[others]), right)
    open_ = jax.vmap(left, in_axes=1, out_axes=1)(slopes[:, strains])
    strained = nearest_solution_in(elastic_energy(system), scales[strains], x[strains], open_, left(right), tolerance)
    rest = of_others(x[others], right - slopes[:, strains] @ strained)
    return scatter_static(scatter_static(x, strains, strained), others, rest)


def nearest_solution_in(
    metric: Float[Array, "n n"] | None,
    scales: Float[Array, " n"],
    x: Float[Array, " n"],
    slopes: Float[Array, "m n"],
    right: Float[Array, " m"],
    tolerance: Scalar | None = None,
) -> Float[Array, " n"]:
    """Solve slopes @ y = right for the y nearest to x in a metric; None: in scales."""
    tolerance = rank_tolerance(x.dtype) if tolerance is None else tolerance
    inverse = invert(metric, slopes, scales, tolerance)
    metric = jnp.diag(scales**-2) if metric is None else metric
    return constrained_solve(inverse, metric, slopes, metric @ x, right)[0]
