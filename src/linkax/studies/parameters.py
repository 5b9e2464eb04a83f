"""Parameters of a fit that stay where they make sense, by what they are functions of."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from linkax.model.bodies import inertia_tensor
from linkax.model.numbers import is_finite, namespace, number, real, require


class AbstractParameter(eqx.Module):
    """A parameter as a function of numbers that may take any value."""

    @property
    @abc.abstractmethod
    def free(self) -> Float[Array, "..."]:
        """The numbers of which the parameter is a function, at its value."""

    @abc.abstractmethod
    def value_of(self, free):
        """The parameter at other such numbers."""


class Positive(AbstractParameter):
    """Numbers that stay positive: fitted by their logarithm. `value`: where the fit starts, any shape."""

    value: Float[Array, "..."]

    def __init__(self, value):
        self.value = _checked("Positive", value, lambda value: value > 0.0, "must be positive")

    @property
    def free(self):
        return jnp.log(self.value)

    def value_of(self, free):
        return jnp.exp(free)


class Bounded(AbstractParameter):
    """Numbers that stay between two bounds. `value`: where the fit starts, between them, any shape."""

    value: Float[Array, "..."]
    lower: Float[Array, ""]
    upper: Float[Array, ""]

    def __init__(self, value, lower, upper):
        self.lower, self.upper = (number(bound, (), "Bounded: bound") for bound in (lower, upper))
        inside = lambda value: (value > self.lower) & (value < self.upper)
        self.value = _checked("Bounded", value, inside, f"must lie between {lower} and {upper}")

    @property
    def free(self):
        return jax.scipy.special.logit((self.value - self.lower) / (self.upper - self.lower))

    def value_of(self, free):
        return self.lower + (self.upper - self.lower) * jax.nn.sigmoid(free)


class Inertia(NamedTuple):
    """Mass [kg], centre of mass [m], (3,), and inertia tensor about it [kg m²], (3, 3), as `RigidBody` takes them."""

    mass: Float[Array, ""]
    center_of_mass: Float[Array, "3"]
    inertia: Float[Array, "3 3"]


class PhysicalInertia(AbstractParameter):
    """The inertia of a body that can exist: some distribution of positive mass has it.

    Fitted by the ten numbers of Rucker and Wensing, Smooth parameterization of rigid-body inertia, IEEE Robotics and
    Automation Letters 7(2), 2022: the pseudo-inertia matrix is U Uᵀ, U upper triangular with a positive diagonal. The
    function that is fitted gets an `Inertia`.

    **Arguments:** `mass`, `center_of_mass`, `inertia` as in `linkax.RigidBody`, where the fit starts: of a body with
    extent along all axes.
    """

    value: Inertia

    def __init__(self, mass, center_of_mass=(0.0, 0.0, 0.0), inertia=(1.0, 1.0, 1.0)):
        mass = number(mass, (), "PhysicalInertia: mass [kg]")
        center_of_mass = number(center_of_mass, (3,), "PhysicalInertia: center_of_mass [m]")
        given, inertia = inertia, inertia_tensor(inertia, "PhysicalInertia: inertia [kg m²]")
        smallest = _least(_pseudo_inertia(mass, center_of_mass, inertia))
        remedy = (
            f"no body with extent along all axes has it and inertia {given} kg m²; all principal moments must be "
            "positive, and each smaller than the sum of the other two"
        )
        mass = require(mass, lambda _: smallest > 0.0, "PhysicalInertia: mass [kg]", remedy)
        self.value = Inertia(mass, center_of_mass, inertia)

    @property
    def free(self):
        # U Uᵀ from the Cholesky factor of the matrix with its rows and columns the other way round.
        upper = jnp.linalg.cholesky(_pseudo_inertia(*self.value)[::-1, ::-1])[::-1, ::-1]
        size = upper[3, 3]
        u = upper / size
        return jnp.array([jnp.log(size), *jnp.log(jnp.diagonal(u)[:3]), u[0, 1], u[1, 2], u[0, 2], *u[:3, 3]])

    def value_of(self, free):
        size, *rest = free
        d1, d2, d3, s12, s23, s13, t1, t2, t3 = rest
        zero, one = jnp.zeros_like(size), jnp.ones_like(size)
        rows = [[jnp.exp(d1), s12, s13, t1], [zero, jnp.exp(d2), s23, t2], [zero, zero, jnp.exp(d3), t3]]
        u = jnp.exp(size) * jnp.array([*rows, [zero, zero, zero, one]])
        pseudo = u @ u.T
        mass, first = pseudo[3, 3], pseudo[:3, 3]
        center = first / mass
        second = pseudo[:3, :3] - mass * jnp.outer(center, center)
        return Inertia(mass, center, jnp.trace(second) * jnp.eye(3) - second)


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


def as_arrays(tree, what):
    """A pytree with arrays in place of numbers and lists; `what` names it in errors."""

    def array(path, leaf):
        try:
            return jnp.asarray(leaf)
        except (TypeError, ValueError, OverflowError) as error:
            name = what + jax.tree_util.keystr(path)
            raise ValueError(f"{name} is {leaf!r}; give a number or an array of numbers") from error

    return jax.tree.map_with_path(array, tree)
