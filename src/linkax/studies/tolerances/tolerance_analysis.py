"""Tell how outputs deviate where parameters do: by derivatives, by samples, and through which parameters."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from linkax.model.numbers import require_bool, require_type, whole_number
from linkax.simulation.integrate.results import ENDED_WELL, REMARKS, RESULTS
from linkax.simulation.read.solution import Solution
from linkax.studies.sweeps.sweep import sweep
from linkax.studies.tolerances.deviations import Deviations
from linkax.studies.tolerances.tolerance_result import (
    SobolIndices,
    Statistics,
    ToleranceAnalysis,
    ToleranceSamples,
    finite,
    varies,
)
from linkax.xla.enumerations import code, is_item
from linkax.xla.tracing import all_concrete
from linkax.xla.waiting import compiling
from scalarjit.code import ByValue

DEFAULT_SAMPLES = 1024  # tell a standard deviation to 2 %
MOST_SAMPLES = 2**30  # of Sobol' points


def tolerance_analysis(
    function: Callable,
    params: Any,
    deviations: Any,
    *,
    correlation: ArrayLike | Sequence | None = None,
    order: int = 2,
    samples: int = DEFAULT_SAMPLES,
    indices: bool = False,
    seed: int = 0,
    **options: Any,
) -> ToleranceAnalysis:
    """Find how outputs deviate where parameters do: to first and second order, and by samples; along a whole motion.

    With deviations x of p parameters, of mean μ and covariance Σ, and the first and second derivatives J and H of an
    output f at μ, mean and variance of the output are

    - to first order f(μ) and J Σ Jᵀ;
    - to second order f(μ) + ½ tr(H Σ) and, for normal deviations, J Σ Jᵀ + ½ tr((H Σ)²). Others add their third and
      fourth moments. With x = μ + L z, z independent of variance 1, skewness γ and excess kurtosis κ, and J and H by z,
      the variance is Σᵢ Jᵢ² + Σᵢ γᵢ Jᵢ Hᵢᵢ + ½ Σᵢⱼ Hᵢⱼ² + ¼ Σᵢ κᵢ Hᵢᵢ², which is exact for a quadratic f. This is the
      method of system moments: Cox, The state of the art of statistical tolerancing, ASQC 1979; Glancy and Chase, A
      second-order method for assembly tolerance analysis, ASME Design Engineering Technical Conferences, 1999;
    - by samples what they come to, whatever f is: scrambled Sobol' points of `scipy.stats.qmc`, in one `linkax.sweep`.

    Without samples it is a pure function, to be used in `jax.jit`, and to be differentiated by `params` and
    `deviations`.

    **Arguments:**

    - `function`: params -> arrays in any pytree, such as readings of a `Solution` at given times. A pure function that
      JAX can trace. A `solution.result` among them tells why a sample failed, see `linkax.sweep`.
    - `params`: pytree of numbers and arrays, as drawn.
    - `deviations`: pytree of the same keys, or some of them; what has none, or None, or zero, is exact. A number is the
      standard deviation of a normal distribution, often taken as a third of a tolerance. Else a frozen distribution of
      `scipy.stats`, of the deviation from what is drawn: `uniform(-t, 2 * t)` for ±t, `uniform(0.0, t)` for +t and −0,
      `truncnorm(-3.0, 3.0, scale=t / 3.0)`. Numbers of an array deviate independently.
    - `correlation`: matrix of the numbers that deviate, (p, p), in the order of `ToleranceAnalysis.names`; normal ones
      alone can be correlated.
    - `order`: 1 or 2. Second derivatives of a simulation compile for minutes, those of `assemble` for seconds.
    - `samples`: how many, a power of two, or 0 for none.
    - `indices`: whether to compute Sobol' indices, from p + 2 times as many samples.
    - `seed`: of the samples.
    - `options`: of `linkax.sweep`, such as `chunk`, `store` and `progress`.

    **Returns:** a `ToleranceAnalysis`.

    **Raises:** `ValueError` for arguments that make no sense; for a function that returns no arrays of real numbers,
    that fails at the mean of the parameters or has no derivative there; and where fewer than two samples ended well.

    **Warns:** as `linkax.sweep` does.
    """
    function = ByValue.each(require_type(function, Callable, "function", "give a function of parameters"))
    whole_number(order, "order", most=2)
    whole_number(seed, "seed", least=0)
    read = Deviations.of(params, deviations, correlation)
    is_traced = not all_concrete((params, deviations))
    _check_samples(samples, indices, read, is_traced)
    with compiling():
        output, slopes, curvatures, results = _expanded(function, read.drawn, read.mean, order)
    if not is_traced:
        _check_expansion(function, read, output, slopes, curvatures, results)
    by_z = jax.tree.map(lambda slope: slope @ read.factor, slopes)
    first = Statistics(output, jax.tree.map(lambda slope: _root(jnp.sum(slope**2, axis=-1)), by_z))
    second = None if curvatures is None else _second_order(read, output, by_z, curvatures)
    return ToleranceAnalysis(
        names=read.names,
        covariance=read.covariance,
        sensitivities=slopes,
        first=first,
        second=second,
        worst_case=_worst_case(read, output, slopes),
        samples=_sampled(function, read, samples, indices, seed, options) if samples else None,
    )


def _check_samples(samples, indices, read, is_traced):
    """Raise a ValueError for samples that cannot be drawn, and for indices that they cannot give."""
    whole_number(samples, "samples", 0, MOST_SAMPLES)
    if samples == 1 or samples & (samples - 1):
        raise ValueError(f"samples is {samples}; give a power of two, as Sobol' points need, such as 1024, or 0")
    if samples and is_traced:
        raise ValueError(f"samples is {samples} within a transformation of JAX; give 0 there, and draw them outside")
    if require_bool(indices, "indices") and (not samples or len(read.names) < 2 or read.correlated):
        raise ValueError(
            f"indices of {', '.join(read.names)} from {samples} samples cannot be computed; give samples, and at least "
            "two numbers that deviate independently"
        )


@eqx.filter_jit
def _expanded(function, drawn, mean, order):
    """The outputs that are floating-point arrays, J with a last axis (p,), H with (p, p) or None, and all results."""
    axes, count = jnp.eye(len(mean), dtype=mean.dtype), len(mean)

    def change(x, u):
        output, slope, results = jax.jvp(lambda x: _split(function(drawn.params(x))), (x,), (u,), has_aux=True)
        return (output, slope), results

    def second_change(u, v):
        (output, slope), (_, curvature), results = jax.jvp(lambda x: change(x, u), (mean,), (v,), has_aux=True)
        return output, slope, curvature, results

    if order == 1:
        (output, slopes), results = jax.vmap(lambda u: change(mean, u))(axes)
        curvatures = None
    else:
        rows, columns = np.triu_indices(count)
        output, slopes, curvatures, results = jax.vmap(second_change)(axes[rows], axes[columns])
        pairs = np.zeros((count, count), int)
        pairs[rows, columns] = pairs[columns, rows] = np.arange(len(rows))
        slopes = jax.tree.map(lambda leaf: leaf[np.diagonal(pairs)], slopes)
        curvatures = jax.tree.map(lambda leaf: jnp.moveaxis(leaf[pairs], (0, 1), (-2, -1)), curvatures)
    slopes = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), slopes)
    output, results = jax.tree.map(lambda leaf: leaf[0], (output, results))
    return output, slopes, curvatures, results


def _split(output):
    """(the floating-point arrays of an output, with None in place of all else; the numbers of its results).

    **Raises:** `ValueError` where there are none.
    """
    special = lambda node: isinstance(node, Solution) or is_item(node, RESULTS) or is_item(node, REMARKS)
    nodes, structure = jax.tree.flatten(output, is_leaf=special)
    numbers = [node if eqx.is_inexact_array(node) else None for node in nodes]
    types = [number.dtype for number in numbers if number is not None]
    if any(isinstance(node, Solution) for node in nodes):
        raise ValueError(
            "the function returns a linkax.Solution; give one that returns readings of it, such as positions"
        )
    if not types or any(jnp.issubdtype(dtype, jnp.complexfloating) for dtype in types):
        raise ValueError(f"the function returns {output!r}; give one that returns arrays of real numbers")
    return jax.tree.unflatten(structure, numbers), [code(node) for node in nodes if is_item(node, RESULTS)]


def _check_expansion(function, read, output, slopes, curvatures, results):
    """Raise a ValueError where the function fails at the mean of the parameters, or has no derivative there."""
    ended_well = [code(getattr(RESULTS, name)) for name in ENDED_WELL]
    is_finite = lambda leaf: bool(np.all(np.isfinite(leaf)))
    is_fine = lambda numbers: bool(np.all(np.isin(numbers, ended_well)))
    if not (all(map(is_finite, jax.tree.leaves(output))) and all(map(is_fine, results))):
        one = sweep(function, read.drawn.params(read.mean[None]), progress=False)
        why = "it returns numbers that are not finite." if one.ok[0] else one.reason(0)
        raise ValueError(
            f"the function fails at the mean of the parameters: {why} Give parameters at which it does not, and saved "
            "times that the motion reaches"
        )
    for order, leaves in (("first", slopes), ("second", curvatures)):
        for index, name in enumerate(read.names):
            if not all(is_finite(leaf[..., index]) for leaf in jax.tree.leaves(leaves)):
                raise ValueError(
                    f"the {order} derivative by {name!r} is not finite at the mean of the parameters; take it out of "
                    "deviations, or ask linkax.differentiability why"
                )


def _root(square):
    """A square root, whose derivative at zero is zero."""
    positive = square > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def _second_order(read, output, by_z, curvatures):
    """The `Statistics` of the second-order expansion, from first derivatives by z."""

    def variance(slope, curvature):
        own = jnp.diagonal(curvature, axis1=-2, axis2=-1)
        of_one = slope**2 + read.skewness * slope * own + 0.25 * read.excess * own**2
        return jnp.sum(of_one, axis=-1) + 0.5 * jnp.sum(curvature**2, axis=(-2, -1))

    curvatures = jax.tree.map(lambda curvature: read.factor.T @ curvature @ read.factor, curvatures)
    mean = jax.tree.map(lambda value, of: value + 0.5 * jnp.trace(of, axis1=-2, axis2=-1), output, curvatures)
    return Statistics(mean, jax.tree.map(lambda slope, of: _root(variance(slope, of)), by_z, curvatures))


def _worst_case(read, output, slopes):
    """(lowest, highest) outputs of the first-order expansion, where each number is at the worse of its ends."""
    ends = [end - read.mean for end in (read.lower, read.upper)]
    at = lambda worse: lambda value, slope: value + jnp.sum(worse(*(slope * end for end in ends)), axis=-1)
    return tuple(jax.tree.map(at(worse), output, slopes) for worse in (jnp.minimum, jnp.maximum))


def _sampled(function, read, count, indices, seed, options) -> ToleranceSamples:
    """Outputs for `count` deviations, and what else Sobol' indices need, in one sweep."""
    from scipy.stats import qmc  # SciPy takes its time

    size = len(read.names)
    points = qmc.Sobol(2 * size if indices else size, rng=np.random.default_rng(seed)).random(count)
    drawn = [read.quantile(part) for part in np.split(points, 2 if indices else 1, axis=1)]
    if indices:
        # The first sample with one of its columns from the second.
        drawn += [np.where(np.arange(size) == column, drawn[1], drawn[0]) for column in range(size)]
    found = sweep(function, read.drawn.params(jnp.asarray(np.concatenate(drawn))), **options)
    output, _ = _split(found.output)
    own, of_samples = jax.tree.map(lambda leaf: leaf[:count] if eqx.is_array(leaf) else leaf, (found, output))
    usable = finite(output) & found.ok
    if (left := np.sum(usable[:count])) < 2:
        raise ValueError(
            f"{left} of {count} samples ended well, too few to tell anything; give smaller deviations. The first that "
            f"failed: {own.reason(int(np.argmin(usable)))}"
        )
    return ToleranceSamples(own, drawn[0], of_samples, _indices(output, usable, count) if indices else None)


def _indices(output, usable, count) -> SobolIndices | None:
    """Sobol' indices of the outputs of all blocks of samples, or None where fewer than two rows of them are usable."""
    from scipy.stats import sobol_indices

    rows = np.flatnonzero(usable.reshape(-1, count).all(axis=0))
    if len(rows) < 2:
        return None
    rows = rows[: 2 ** int(np.log2(len(rows)))]  # SciPy takes a power of two
    leaves, structure = jax.tree.flatten(output)
    flat = [leaf.reshape(-1, count, math.prod(leaf.shape[1:]))[:, rows] for leaf in leaves]
    flat = [np.where(varies(leaf[0].std(axis=0), leaf[0]), leaf, 0.0) for leaf in flat]
    f_a, f_b, *f_ab = np.moveaxis(np.concatenate(flat, axis=-1), 1, -1)
    estimate = sobol_indices(func={"f_A": f_a, "f_B": f_b, "f_AB": np.array(f_ab)}, n=len(rows))
    ends = np.cumsum([leaf.shape[-1] for leaf in flat])[:-1]
    parts = [np.split(of.reshape(-1, len(f_ab)), ends) for of in (estimate.first_order, estimate.total_order)]
    shaped = lambda part: [of.reshape(*leaf.shape[1:], -1) for of, leaf in zip(part, leaves, strict=True)]
    first, total = (jax.tree.unflatten(structure, shaped(part)) for part in parts)
    return SobolIndices(first, total, len(rows), estimate)
