"""Read how numbers of parameters deviate from what was drawn."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from linkax.model.numbers import is_finite, number, real, require
from linkax.studies.parameters.free_parameters import FreeParameters
from linkax.studies.parameters.parameters import AbstractParameter, as_arrays
from linkax.studies.parameters.paths import path_parts
from linkax.xla.arrays import Array
from linkax.xla.tracing import all_concrete, concrete

WORST = 3.0  # standard deviations that count as the worst case where a distribution has no end
UNIT_DIAGONAL = 1e-9  # up to which rounding is let pass in a matrix of correlations


class Place(NamedTuple):
    """Where numbers that deviate are: the index of their leaf, its shape, and their positions in it, flattened."""

    leaf: int
    shape: tuple[int, ...]
    positions: tuple[int, ...]


class Drawn(NamedTuple):
    """Parameters without deviation, and which p of their numbers deviate.

    `leaves`: as arrays; `structure`: the pytree that they are leaves of; `places`: of the numbers that deviate.
    """

    leaves: list[Array]
    structure: Any
    places: list[Place]

    def params(self, x: Float[Array, "*n p"]) -> Any:
        """The parameters with deviations x, each with the axes of x before the last one."""
        leaves, start, axes = [*self.leaves], 0, x.shape[:-1]
        for leaf, shape, positions in self.places:
            stop = start + len(positions)
            added = jnp.zeros((*axes, math.prod(shape))).at[..., np.array(positions)].set(x[..., start:stop])
            leaves[leaf] = leaves[leaf] + added.reshape(*axes, *shape)
            start = stop
        leaves = [jnp.broadcast_to(leaf, (*axes, *of.shape)) for leaf, of in zip(leaves, self.leaves, strict=True)]
        return jax.tree.unflatten(self.structure, leaves)


class Deviations(NamedTuple):
    """Deviations x = mean + factor z of p numbers, where z are independent, of mean 0 and variance 1.

    - `drawn`: the parameters without them. `names`: of the numbers that deviate.
    - `distributions`: of each place in `drawn`, frozen, of SciPy; None for normal ones.
    - `skewness`, `excess`: of z, (p,), the latter the kurtosis less that of a normal one.
    - `lower`, `upper`: the worst cases of x, (p,).
    """

    drawn: Drawn
    names: list[str]
    distributions: list[Any]
    mean: Float[Array, " p"]
    factor: Float[Array, "p p"]
    skewness: Float[Array, " p"]
    excess: Float[Array, " p"]
    lower: Float[Array, " p"]
    upper: Float[Array, " p"]

    @staticmethod
    def of(params: Any, deviations: Any, correlation: ArrayLike | Sequence | None) -> "Deviations":
        """Read the arguments of `linkax.tolerance_analysis`.

        **Raises:** `ValueError` for each that makes no sense, by name.
        """
        names = _names(params)
        leaves, structure = jax.tree.flatten(as_arrays(params, "params"))
        places, distributions, moments, varied, normal, start = [], [], [], [], [], 0
        given = matched(deviations, jax.tree.unflatten(structure, leaves), "deviations", is_distribution)
        for index, (leaf, (what, entry)) in enumerate(zip(leaves, given, strict=True)):
            own = names[start : start + leaf.size]
            start += leaf.size
            if entry is None:
                continue
            by_distribution = is_distribution(entry)
            positions, columns = (_of_distribution if by_distribution else _normal)(entry, leaf.shape, what)
            if positions:
                leaves[index] = jnp.asarray(leaf, float)
                places.append(Place(index, leaf.shape, positions))
                distributions.append(entry if by_distribution else None)
                moments.append(columns)
                varied += [own[position] for position in positions]
                normal += [not by_distribution] * len(positions)
        if not places:
            raise ValueError(f"deviations are {deviations!r}, so that nothing deviates; give one that is not zero")
        mean, deviation, *rest = (jnp.concatenate(parts) for parts in zip(*moments, strict=True))
        factor = deviation[:, None] * _factor(correlation, varied, np.array(normal))
        return Deviations(Drawn(leaves, structure, places), varied, distributions, mean, factor, *rest)

    @property
    def covariance(self) -> Float[Array, "p p"]:
        """Of the numbers that deviate."""
        return self.factor @ self.factor.T

    @property
    def correlated(self) -> bool:
        """Whether some numbers depend on each other."""
        return bool(np.any(np.asarray(self.factor)[~np.eye(len(self.names), dtype=bool)] != 0.0))

    def quantile(self, shares: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "n p"]:
        """Deviations x from numbers between 0 and 1, which of independent uniform ones have their distributions."""
        from scipy.special import ndtri  # SciPy takes its time

        inside = np.clip(shares, np.finfo(float).eps / 2, 1.0 - np.finfo(float).eps / 2)
        x, start = ndtri(inside) @ np.asarray(self.factor).T, 0
        for place, distribution in zip(self.drawn.places, self.distributions, strict=True):
            part = slice(start, start + len(place.positions))
            start = part.stop
            if distribution is not None:
                x[:, part] = distribution.ppf(inside[:, part].reshape(-1, *place.shape)).reshape(len(x), -1)
        return x


def is_distribution(entry: Any) -> bool:
    """Whether this is a frozen distribution of SciPy."""
    return all(callable(getattr(entry, name, None)) for name in ("ppf", "stats", "support"))


def matched(entries: Any, tree: Any, what: str, is_leaf: Any = None) -> list[tuple[str, Any]]:
    """Of each leaf of a tree, what to call it and its entry in a pytree of the same keys, or some of them.

    An entry holds for all leaves below it; where there is none, it is None.

    **Raises:** `ValueError` for entries that belong to no leaf.
    """
    paths = [tuple(path_parts(path)) for path, _ in jax.tree.leaves_with_path(tree)]
    found: list[tuple[str, Any]] = [(what, None)] * len(paths)
    for path, entry in jax.tree.leaves_with_path(entries, is_leaf=is_leaf):
        name, parts = what + jax.tree_util.keystr(path), tuple(path_parts(path))
        below = [index for index, whole in enumerate(paths) if whole[: len(parts)] == parts]
        if not below:
            known = ", ".join(repr(".".join(whole)) for whole in paths)
            raise ValueError(
                f"{name} is {entry!r}, and belongs to none of {known}; use these keys, and arrays for arrays"
            )
        for index in below:
            found[index] = (name, entry)
    return found


def _names(params) -> list[str]:
    """Names of all numbers in params.

    **Raises:** `ValueError` for what are no plain, finite numbers.
    """
    free = FreeParameters.of(params)
    for name, leaf in zip(free.leaf_names, free.leaves, strict=True):
        if isinstance(leaf, AbstractParameter):
            raise ValueError(f"parameter {name!r} is {leaf!r}; give plain numbers, such as those in linkax.Fit.params")
    return free.names


def _normal(entry, shape, what):
    """(positions, moments) of numbers that deviate normally, by their standard deviations."""
    remedy = "it must be finite, and zero or more"
    deviation = require(real(entry, what), lambda x: is_finite(x) & (x >= 0.0).all(), what, remedy)
    deviation = jnp.ravel(_broadcast(deviation, shape, what))
    known = concrete(deviation)
    positions = np.arange(deviation.size) if known is None else np.flatnonzero(known)
    deviation = deviation[positions]
    none = jnp.zeros(len(positions))
    worst = WORST * deviation
    return tuple(positions.tolist()), (none, deviation, none, none, -worst, worst)


def _of_distribution(entry, shape, what):
    """(positions, moments) of numbers with a distribution."""
    mean, variance, skewness, excess = (_broadcast(part, shape, what).ravel() for part in entry.stats(moments="mvsk"))
    if not (np.all(np.isfinite([mean, variance, skewness, excess])) and np.all(variance > 0.0)):
        raise ValueError(
            f"{what} has mean {mean.tolist()}, variance {variance.tolist()}, skewness {skewness.tolist()} and excess "
            f"kurtosis {excess.tolist()}; give a distribution of finite moments and positive variance"
        )
    deviation = np.sqrt(variance)
    ends = [_broadcast(end, shape, what).ravel() for end in entry.support()]
    worst = [
        np.where(np.isfinite(end), end, mean + sign * WORST * deviation)
        for end, sign in zip(ends, (-1.0, 1.0), strict=True)
    ]
    return tuple(range(len(mean))), (mean, deviation, skewness, excess, *worst)


def _broadcast(array, shape, what):
    """An array in the shape of a parameter."""
    try:
        return (jnp if isinstance(array, jax.Array) else np).broadcast_to(array, shape)
    except ValueError as error:
        raise ValueError(
            f"{what} has shape {np.shape(array)}; give a single number, or shape {shape} as the parameter has"
        ) from error


def _factor(correlation, names, normal):
    """A matrix whose product with its transpose is the matrix of correlations; of what is independent, that of one."""
    count = len(names)
    factor = np.eye(count)
    if correlation is None:
        return factor
    what = f"correlation of {', '.join(names)}"
    if not all_concrete(correlation):
        raise ValueError(f"{what} is {correlation!r}, traced; give numbers, which no transformation traces")
    matrix = np.asarray(number(correlation, (count, count), what))
    right = np.allclose(matrix, matrix.T, atol=UNIT_DIAGONAL) and np.allclose(np.diag(matrix), 1.0, atol=UNIT_DIAGONAL)
    least = np.linalg.eigvalsh(matrix)[0] if right else -1.0
    if least < -UNIT_DIAGONAL * count:
        raise ValueError(
            f"{what} is {matrix.tolist()}; give a symmetric, positive semidefinite matrix with ones in its diagonal"
        )
    together = np.any((matrix != 0.0) & ~np.eye(count, dtype=bool), axis=1)
    for name in np.array(names)[together & ~normal]:
        raise ValueError(
            f"correlation of {name!r} with others: it is not normal; give it a standard deviation, or zeros"
        )
    sizes, axes = np.linalg.eigh(matrix[np.ix_(together, together)])
    factor[np.ix_(together, together)] = axes * np.sqrt(np.maximum(sizes, 0.0))
    return factor
