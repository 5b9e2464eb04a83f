"""The result of a tolerance analysis."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from linkax.model.numbers import namespace, real, require
from linkax.studies.sweeps.sweep_result import Sweep
from linkax.studies.tolerances.deviations import matched
from linkax.tables import Rows, Table, count, numbers, printed_as
from linkax.xla.arrays import Array

ROUNDING = 1e-12  # standard deviation, relative to the largest entry of an array, up to which it is one of rounding
MOST_OUTPUTS = 4  # in columns of a table


def varies(deviation: Any, values: Any) -> Any:
    """Whether standard deviations in an array are more than rounding of its values."""
    return deviation > ROUNDING * namespace(values).max(abs(values), initial=np.finfo(float).tiny)


def finite(output: Any) -> Bool[np.ndarray, " n"]:
    """Whether all outputs of each sample are finite, (n,)."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(output)]
    return np.all([np.isfinite(leaf).reshape(len(leaf), -1).all(axis=1) for leaf in leaves], axis=0)


def _table(analysis: "ToleranceAnalysis") -> Table:
    samples, facts = analysis.samples, []
    if samples is not None:
        failed = np.flatnonzero(~samples.ok)
        facts.append(("samples", f"{len(samples.ok)}, {len(failed)} of them failed"))
        facts += [("the first to fail", f"{member}: {samples.sweep.reason(member)}") for member in failed[:1].tolist()]
    methods = {"first order": analysis.first, "second order": analysis.second, "samples": samples}
    known = {name: jax.tree.leaves(of.standard_deviation) for name, of in methods.items() if of is not None}
    names = [f"output{jax.tree_util.keystr(path)}" for path, _ in jax.tree.leaves_with_path(analysis.first.mean)]
    outputs = [(name, *map(numbers, row)) for name, *row in zip(names, *known.values(), strict=True)]
    columns = {"": analysis.names, "standard deviation": map(numbers, np.sqrt(np.diagonal(analysis.covariance)))}
    for name, share, deviation in zip(
        names[:MOST_OUTPUTS], jax.tree.leaves(analysis.contributions), known["first order"], strict=False
    ):
        columns[f"share of {name}"] = [f"{100.0 * part:.3g} %" for part in _together(share, deviation)]
    if samples is not None and samples.indices is not None:
        of_output = zip(
            names[:MOST_OUTPUTS], *map(jax.tree.leaves, samples.indices[:2]), known["samples"], strict=False
        )
        for name, first, total, deviation in of_output:
            both = zip(_together(first, deviation), _together(total, deviation), strict=True)
            columns[f"Sobol' indices of {name}"] = [f"{one:.2f}, {other:.2f}" for one, other in both]
    return Table(
        f"Tolerance analysis of {count(len(analysis.names), 'number')}",
        [
            Rows((), facts),
            Rows(("standard deviation of", *known), outputs, "outputs"),
            Rows(tuple(columns), list(zip(*columns.values(), strict=True)), "numbers"),
        ],
    )


def _together(shares, deviation):
    """Shares of the sum of all variances in an array, from those of each, (p,)."""
    weights = np.square(np.asarray(deviation))[..., None]
    axes = tuple(range(weights.ndim - 1))
    return np.sum(shares * weights, axis=axes) / max(np.sum(weights), np.finfo(float).tiny)


class Statistics(NamedTuple):
    """Mean and standard deviation of each output, or the standard errors of these, in the structure of the outputs."""

    mean: Any
    standard_deviation: Any


class SobolIndices(NamedTuple):
    """Sobol' indices: the shares of an output's variance that vanish with the deviations of a number.

    - `first`: by that number alone. `total`: also by what it does together with others. Both in the structure of the
      outputs, with a last axis of p numbers; zero for outputs that do not vary.
    - `count`: samples that they were computed from: the largest power of two for which all that they need ended well.
    - `estimate`: SciPy's `SobolResult` of all outputs in one row; its `bootstrap()` has intervals of confidence.
    """

    first: Any
    total: Any
    count: int
    estimate: Any


class ToleranceSamples(NamedTuple):
    """Outputs for n sampled deviations. Means and their like are over those that ended well.

    - `sweep`: how each of them ended, and all that the function returned.
    - `deviations`: (n, p). `output`: the arrays of floating-point numbers, with a first axis (n,).
    - `indices`: `SobolIndices`, where they were asked for and two samples or more ended well with all that they need.
    """

    sweep: Sweep
    deviations: Float[np.ndarray, "n p"]
    output: Any
    indices: SobolIndices | None

    @property
    def ok(self) -> Bool[np.ndarray, " n"]:
        """Whether each sample ended well, with finite outputs, (n,)."""
        return self.sweep.ok & finite(self.output)

    @property
    def mean(self) -> Any:
        """Of each output."""
        return self._each(lambda values: np.mean(values, axis=0))

    @property
    def standard_deviation(self) -> Any:
        """Of each output."""
        return self._each(lambda values: np.std(values, axis=0, ddof=1))

    @property
    def standard_errors(self) -> Statistics:
        """Of mean and standard deviation, as of independent samples; those of Sobol' points are mostly smaller."""

        def of_deviation(values):
            squares = np.square(values - np.mean(values, axis=0))
            variance = np.mean(squares, axis=0)
            error = np.sqrt(np.mean(np.square(squares - variance), axis=0) / len(values))
            return error / (2.0 * np.sqrt(np.where(variance > 0.0, variance, 1.0)))

        of_mean = self._each(lambda values: np.std(values, axis=0, ddof=1) / np.sqrt(len(values)))
        return Statistics(of_mean, self._each(of_deviation))

    @property
    def range(self) -> tuple[Any, Any]:
        """Lowest and highest values of each output."""
        return self._each(lambda values: np.min(values, axis=0)), self._each(lambda values: np.max(values, axis=0))

    def quantile(self, share: float) -> Any:
        """The values of each output that this share of the samples stays below.

        **Raises:** `ValueError` for a share that is not between 0 and 1.
        """
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"share is {share!r}; it must lie between 0 and 1, such as 0.95")
        return self._each(lambda values: np.quantile(values, share, axis=0))

    def within(self, lower: Any = None, upper: Any = None, level: float = 0.95) -> tuple[float, tuple[float, float]]:
        """The share of samples with all outputs within limits; one that failed is not.

        **Arguments:** `lower`, `upper`: pytrees of numbers, or arrays of the shape of an output; for all outputs, for
        some keys of them, or None. `level`: of confidence of the interval.

        **Returns:** (share, (lower, upper)), the latter the interval of confidence of Clopper and Pearson.

        **Raises:** `ValueError` for limits of other keys or shapes, and for a level that is not between 0 and 1.
        """
        from scipy.stats import binomtest  # SciPy takes its time

        if not 0.0 < level < 1.0:
            raise ValueError(f"level is {level!r}; it must lie between 0 and 1, such as 0.95")
        inside = self.ok
        for what, limits, keeps in (("lower", lower, np.greater_equal), ("upper", upper, np.less_equal)):
            leaves = jax.tree.leaves(self.output)
            for leaf, (name, limit) in zip(leaves, matched(limits, self.output, what), strict=True):
                if limit is not None:
                    inside &= keeps(leaf, _limit(limit, leaf, name)).reshape(len(leaf), -1).all(axis=1)
        counted = binomtest(int(np.sum(inside)), len(inside))
        interval = counted.proportion_ci(level)
        return float(counted.statistic), (float(interval.low), float(interval.high))

    def _each(self, statistic):
        ok = self.ok
        return jax.tree.map(lambda leaf: statistic(np.asarray(leaf)[ok]), self.output)


def _limit(limit, leaf, name):
    """A limit in the shape of an output.

    **Raises:** `ValueError` for what is no number, and for another shape.
    """
    array = require(real(limit, name), lambda x: not np.any(np.isnan(x)), name, "it must not be NaN")
    if array.shape not in ((), leaf.shape[1:]):
        raise ValueError(
            f"{name} has shape {array.shape}; give a single number, or shape {leaf.shape[1:]} as the output"
        )
    return np.asarray(array)


@printed_as(_table)
class ToleranceAnalysis(NamedTuple):
    """How outputs deviate where p numbers of parameters do.

    Pytrees are in the structure of the function's output, with None in place of what is no floating-point array.

    - `names`: of the numbers that deviate. `covariance`: of them, (p, p).
    - `sensitivities`: derivatives of the outputs by these numbers, with a last axis (p,).
    - `first`, `second`: `Statistics` by first and second derivatives; `second` is None for `order=1`.
    - `worst_case`: (lowest, highest) outputs of the first-order expansion over all combinations of the ends of the
      deviations; an end that a distribution has not is three standard deviations from its mean.
    - `samples`: `ToleranceSamples`, or None.
    """

    names: list[str]
    covariance: Float[Array, "p p"]
    sensitivities: Any
    first: Statistics
    second: Statistics | None
    worst_case: tuple[Any, Any]
    samples: ToleranceSamples | None

    @property
    def contributions(self) -> Any:
        """Share of each number in the first-order variance, J ∘ (J Σ) / (J Σ Jᵀ), with a last axis (p,).

        They add to one; one can be negative where deviations are correlated. Zero for outputs that do not vary.
        """

        def shares(slope, deviation, value):
            moves = varies(deviation, value)
            variance = jnp.where(moves, deviation, 1.0)[..., None] ** 2
            return jnp.where(moves[..., None], slope * (slope @ self.covariance) / variance, 0.0)

        return jax.tree.map(shares, self.sensitivities, self.first.standard_deviation, self.first.mean)
