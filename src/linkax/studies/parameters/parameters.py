"""Parameters of a fit that stay physical, as functions of numbers without bounds."""

import abc
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import ArrayLike, Float

from linkax.model.bodies import inertia_tensor
from linkax.model.numbers import is_finite, namespace, number, real, require
from linkax.xla.arrays import Array

OF_LOGARITHM = 2.0  # the longest step of a logarithm: a linear model of its exponential tells little of longer ones


class AbstractParameter(eqx.Module):
    """A parameter as a function of free numbers, which may take any value. `value`: where the fit starts."""

    # Whether the free numbers are known beforehand to be normal, with mean 0 and standard deviation 1.
    has_prior: ClassVar[bool] = False
    # Between which the free numbers are.
    ends: ClassVar[tuple[float, float]] = (-np.inf, np.inf)

    value: eqx.AbstractVar[Any]

    @property
    @abc.abstractmethod
    def free(self) -> Float[Array, "..."]:
        """The free numbers at the parameter's value."""

    @abc.abstractmethod
    def value_of(self, free: Float[Array, "..."]) -> Any:
        """The parameter as a function of the free numbers."""

    @property
    def longest(self) -> Any:
        """How far one step may change each free number; finite of those whose exponential the parameter is."""
        return np.inf


class Positive(AbstractParameter):
    """Numbers that stay positive, fitted by their logarithm.

    **Arguments:** `value`: where the fit starts, of any shape.

    **Raises:** `ValueError` for numbers that are not positive and finite.
    """

    value: Float[Array, "..."]

    def __init__(self, value: ArrayLike | Sequence) -> None:
        self.value = _checked("Positive", value, lambda value: value > 0.0, "must be positive")

    @property
    def free(self) -> Float[Array, "..."]:
        return jnp.log(self.value)

    def value_of(self, free: Float[Array, "..."]) -> Float[Array, "..."]:
        return jnp.exp(free)

    @property
    def longest(self) -> Any:
        return OF_LOGARITHM


class Bounded(AbstractParameter):
    """Numbers that stay between two bounds, fitted by their place between them, from 0 to 1.

    Steps of a fit end before a bound; one that starts on a bound may stay there.

    **Arguments:** `value`: where the fit starts, of any shape. `lower`, `upper`: the bounds, one number each.

    **Raises:** `ValueError` for numbers that are beyond the bounds, and for bounds that are not in rising order.
    """

    ends = (0.0, 1.0)

    value: Float[Array, "..."]
    lower: Float[Array, ""]
    upper: Float[Array, ""]

    def __init__(self, value: ArrayLike | Sequence, lower: ArrayLike, upper: ArrayLike) -> None:
        self.lower, self.upper = (number(bound, (), "Bounded: bound") for bound in (lower, upper))
        inside = lambda value: (self.lower < self.upper) & (value >= self.lower) & (value <= self.upper)
        self.value = _checked("Bounded", value, inside, f"must lie between {lower} and {upper}, in rising order")

    @property
    def free(self) -> Float[Array, "..."]:
        return (self.value - self.lower) / (self.upper - self.lower)

    def value_of(self, free: Float[Array, "..."]) -> Float[Array, "..."]:
        # Line searches and intervals ask beyond the ends. By selection, which has a derivative at the ends.
        place = jnp.where(free < 0.0, 0.0, jnp.where(free > 1.0, 1.0, free))
        return (1.0 - place) * self.lower + place * self.upper


class Normal(AbstractParameter):
    """Numbers of which a mean and a standard deviation are known beforehand: a prior, or a regularisation.

    The fit adds half the square of (value − mean) / deviation to the loss, so a residual beside it must be in units of
    its noise, as that of `linkax.Experiment` is.

    **Arguments:** `mean`, `deviation`: of any shape that fit to each other. `value`: where the fit starts, by default
    the mean.

    **Raises:** `ValueError` for a deviation that is not positive, and numbers that are not finite.
    """

    has_prior = True

    value: Float[Array, "..."]
    mean: Float[Array, "..."]
    deviation: Float[Array, "..."]

    def __init__(
        self, mean: ArrayLike | Sequence, deviation: ArrayLike | Sequence, value: ArrayLike | Sequence | None = None
    ) -> None:
        given = jnp.asarray(real(mean, "Normal: mean")), jnp.asarray(real(deviation, "Normal: deviation"))
        mean, self.deviation = jnp.broadcast_arrays(*given)
        self.mean = require(mean, is_finite, "Normal: mean", "it must be finite")
        self.deviation = require(
            self.deviation, lambda d: is_finite(d) & (d > 0.0).all(), "Normal: deviation", "it must be positive"
        )
        start = mean if value is None else jnp.broadcast_to(jnp.asarray(real(value, "Normal: value")), mean.shape)
        self.value = require(start, is_finite, "Normal: value", "it must be finite")

    @property
    def free(self) -> Float[Array, "..."]:
        return (self.value - self.mean) / self.deviation

    def value_of(self, free: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.mean + self.deviation * free


class LogNormal(AbstractParameter):
    """Positive numbers known beforehand but for a factor: the logarithm has a `Normal` prior.

    **Arguments:** `median`: of any shape. `factor`: larger than 1; the number is within median / factor and
    median × factor with a probability of 68 %. `value`: where the fit starts, by default the median.

    **Raises:** `ValueError` for numbers that are not positive, and a factor that is not larger than 1.
    """

    has_prior = True

    value: Float[Array, "..."]
    median: Float[Array, "..."]
    factor: Float[Array, ""]

    def __init__(
        self, median: ArrayLike | Sequence, factor: ArrayLike, value: ArrayLike | Sequence | None = None
    ) -> None:
        positive = lambda entry: _checked("LogNormal", entry, lambda x: x > 0.0, "must be positive")
        self.median = positive(median)
        larger = "it must be larger than 1"
        self.factor = jnp.asarray(require(number(factor, (), "LogNormal: factor"), lambda x: x > 1.0, "factor", larger))
        self.value = self.median if value is None else jnp.broadcast_to(positive(value), self.median.shape)

    @property
    def free(self) -> Float[Array, "..."]:
        return jnp.log(self.value / self.median) / jnp.log(self.factor)

    def value_of(self, free: Float[Array, "..."]) -> Float[Array, "..."]:
        return self.median * self.factor**free

    @property
    def longest(self) -> Any:
        return OF_LOGARITHM / jnp.log(self.factor)


class Inertia(NamedTuple):
    """Inertia of a rigid body, as `linkax.RigidBody` takes it.

    - `mass` [kg]. `center_of_mass`: in the body's reference frame, (3,) [m].
    - `inertia`: tensor about the centre of mass, (3, 3) [kg m²].
    """

    mass: Float[Array, ""]
    center_of_mass: Float[Array, "3"]
    inertia: Float[Array, "3 3"]


class PhysicalInertia(AbstractParameter):
    """The inertia of a body that can exist: some distribution of positive mass has it.

    The fitted function gets an `Inertia`. It is fitted by the ten numbers of Rucker and Wensing, Smooth
    parameterization of rigid-body inertia, IEEE Robotics and Automation Letters 7(2), 2022: the pseudo-inertia matrix
    is U Uᵀ, where U is upper triangular with a positive diagonal.

    **Arguments:** `mass`, `center_of_mass`, `inertia` as in `linkax.RigidBody`, where the fit starts.

    **Raises:** `ValueError` for the inertia of a body that has no extent along some axis, or that cannot exist.
    """

    value: Inertia

    def __init__(
        self,
        mass: ArrayLike,
        center_of_mass: ArrayLike | Sequence = (0.0, 0.0, 0.0),
        inertia: ArrayLike | Sequence = (1.0, 1.0, 1.0),
    ) -> None:
        m = number(mass, (), "PhysicalInertia: mass [kg]")
        center = number(center_of_mass, (3,), "PhysicalInertia: center_of_mass [m]")
        matrix: Any = inertia
        tensor = inertia_tensor(matrix, "PhysicalInertia: inertia [kg m²]")
        smallest = _least(_pseudo_inertia(m, center, tensor))
        remedy = (
            f"no body with extent along all axes has it and inertia {inertia} kg m²; all principal moments must be "
            "positive, and each smaller than the sum of the other two"
        )
        m = require(m, lambda _: smallest > 0.0, "PhysicalInertia: mass [kg]", remedy)
        self.value = Inertia(m, center, tensor)

    @property
    def free(self) -> Float[Array, "10"]:
        # U from the Cholesky factor of the matrix with the order of its rows and columns reversed.
        upper = jnp.linalg.cholesky(_pseudo_inertia(*self.value)[::-1, ::-1])[::-1, ::-1]
        size = upper[3, 3]
        u = upper / size
        return jnp.array([jnp.log(size), *jnp.log(jnp.diagonal(u)[:3]), u[0, 1], u[1, 2], u[0, 2], *u[:3, 3]])

    def value_of(self, free: Float[Array, "10"]) -> Inertia:
        size, d1, d2, d3, s12, s23, s13, t1, t2, t3 = free
        zero, one = jnp.zeros_like(size), jnp.ones_like(size)
        rows = [[jnp.exp(d1), s12, s13, t1], [zero, jnp.exp(d2), s23, t2], [zero, zero, jnp.exp(d3), t3]]
        u = jnp.exp(size) * jnp.array([*rows, [zero, zero, zero, one]])
        pseudo = u @ u.T
        mass, first = pseudo[3, 3], pseudo[:3, 3]
        center = first / mass
        second = pseudo[:3, :3] - mass * jnp.outer(center, center)
        return Inertia(mass, center, jnp.trace(second) * jnp.eye(3) - second)

    @property
    def longest(self) -> Any:
        # The inertia is quadratic in U, and the first four numbers are logarithms.
        return jnp.array(4 * [OF_LOGARITHM / 2.0] + 6 * [jnp.inf])


def _pseudo_inertia(mass, center, inertia):
    """[[∫ r rᵀ dm, ∫ r dm], [∫ rᵀ dm, m]] about the origin of the body, (4, 4)."""
    second = 0.5 * jnp.trace(inertia) * jnp.eye(3) - inertia + mass * jnp.outer(center, center)
    first = mass * jnp.asarray(center)[:, None]
    return jnp.block([[second, first], [first.T, jnp.reshape(mass, (1, 1))]])


def _least(matrix):
    """The smallest eigenvalue, without derivative."""
    return namespace(matrix).linalg.eigvalsh(lax.stop_gradient(matrix)).min()


def _checked(kind, value, condition, remedy):
    array = jnp.asarray(real(value, f"{kind}: value"))
    right = lambda value: is_finite(value) & condition(value).all()
    return require(array, right, f"{kind}: value", f"it {remedy}, and be finite")


def as_arrays(tree: Any, what: str) -> Any:
    """A pytree with arrays in place of numbers; `what` names it in errors.

    **Raises:** `ValueError` for a leaf that is no number.
    """

    def array(path, leaf):
        try:
            return jnp.asarray(leaf)
        except (TypeError, ValueError, OverflowError) as error:
            name = what + jax.tree_util.keystr(path)
            raise ValueError(f"{name} is {leaf!r}; give a number or an array of numbers") from error

    return jax.tree.map_with_path(array, tree)
