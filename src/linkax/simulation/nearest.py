"""Least changes of coordinates and speeds, in which beams are strained as little as can be."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag

from linkax.linalg.constrained_solve import constrained_solve, invert
from linkax.linalg.placing import placed
from linkax.model.beams import BeamElasticity
from linkax.simulation.accuracy import BALANCED


def rank_tolerance(dtype):
    """For independent rows, of everything that is assembled."""
    return BALANCED.method(dtype).rank_tolerance


def beams_of(system):
    """The elastic forces of beams."""
    return [force for force in system.forces if isinstance(force, BeamElasticity)]


def strains_of(system):
    """Where the strains of beams are among the speeds."""
    taken = [system.topology.speeds[beam.beam] for beam in beams_of(system)]
    return np.concatenate([np.zeros(0, int), *(np.arange(of.start, of.stop) for of in taken)])


def elastic_energy(system):
    """Twice that of the strains of beams, as a matrix."""
    return block_diag(*(beam.matrix for beam in beams_of(system)))


def nearest(system, x, slopes, right, tolerance=None):
    """What is nearest to x, in radians and lengths of the mechanism, with slopes @ x = right.

    Strains of beams differ from x, by as little energy as they can, only in what all else leaves open. `tolerance`:
    for independent rows, by default `rank_tolerance`.
    """
    strains, units = strains_of(system), system.units
    if not len(strains):
        return nearest_in(None, units, x, slopes, right, tolerance)
    others = np.setdiff1d(np.arange(len(units)), strains)
    of_others = lambda x, right: nearest_in(None, units[others], x, slopes[:, others], right, tolerance)
    left = lambda right: right - slopes[:, others] @ of_others(jnp.zeros_like(x[others]), right)
    open_ = jax.vmap(left, in_axes=1, out_axes=1)(slopes[:, strains])
    strained = nearest_in(elastic_energy(system), units[strains], x[strains], open_, left(right), tolerance)
    rest = of_others(x[others], right - slopes[:, strains] @ strained)
    return placed(placed(x, strains, strained), others, rest)


def nearest_in(metric, units, x, slopes, right, tolerance=None):
    """What is nearest to x in a metric, or in units for None, with slopes @ x = right."""
    tolerance = rank_tolerance(x.dtype) if tolerance is None else tolerance
    inverse = invert(metric, slopes, units, tolerance)
    metric = jnp.diag(units**-2) if metric is None else metric
    return constrained_solve(inverse, metric, slopes, metric @ x, right)[0]
