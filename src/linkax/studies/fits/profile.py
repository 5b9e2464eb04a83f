"""Profile the likelihood of one parameter, refitting all others."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import ArrayLike, Float

from linkax.model.numbers import is_finite, real, require, require_type, whole_number
from linkax.studies.fits.fit_result import Fit
from linkax.studies.fits.fit_search import Squares, checked_tolerance, search_from_each, sensitivity
from linkax.studies.fits.levenberg_marquardt import LevenbergMarquardt
from linkax.studies.fits.profile_result import Profile
from linkax.studies.laboratory.experiments import Experiment
from linkax.studies.laboratory.laboratory import Laboratory
from linkax.studies.parameters.free_parameters import NEAREST
from linkax.studies.parameters.parameters import as_arrays
from linkax.tables import one
from linkax.xla.arrays import Array
from linkax.xla.users_line import warn
from linkax.xla.waiting import compiling
from scalarjit.code import ByValue

LEVEL = 0.95  # of the interval that a profile is wide enough for
WIDTH = 2.0  # of the values by default, in half widths of that interval
UNKNOWN = 1.0  # the same for a parameter without standard error, in free numbers
ROUNDING = 1e-8  # of a residual
BETTER = 1e-3  # of the noise squared: by how much less a loss is that of another minimum


class _Held(Squares):
    """Steps that leave one entry of z as it is, since the residual seems not to depend on it."""

    entry: int = eqx.field(static=True)

    def flat(self, z: Float[Array, " p"], args: tuple) -> Float[Array, " n"]:
        return super().flat(jnp.where(jnp.arange(len(z)) == self.entry, lax.stop_gradient(z), z), args)


def profile(
    function: Callable | Experiment | Sequence[Experiment],
    found: Fit,
    name: str,
    args: tuple | list = (),
    *,
    values: ArrayLike | Sequence[float] | None = None,
    count: int = 21,
    steps: int = 100,
    tolerance: int | float = 1e-6,
) -> Profile:
    """Refit all other parameters at each of several values of one: the profile of its likelihood.

    Where the residual bends within the standard errors, intervals of `Fit` are wrong, and those of the profile follow
    the likelihood (Bates and Watts, Nonlinear Regression Analysis and Its Applications, 1988, chapter 6). All refits
    are one batch, by Levenberg and Marquardt's method, each from where the covariance puts the other parameters.

    **Arguments:**

    - `function`, `args`: the residual and its further arguments, or the experiments, as they were fitted. `found`: the
      `Fit`, whose noise of sensors stays.
    - `name`: of a number among `found.names`, such as "mass", or "springs[1]" of an array.
    - `values`: of that number, (n,), in any order. By default `count` ones that reach twice as far as the interval of
      95 %, or, where the data determine none, as far as the parameter itself; and no further than its bounds.
    - `steps`, `tolerance`: of each refit, as in `linkax.fit`.

    **Returns:** a `Profile`. A refit that fails is marked, and harms no other.

    Priors are parts of the likelihood; the residual must then be in units of its noise. Near the fit, intervals are
    those of its covariance, with priors and robust losses, too.

    **Raises:** `ValueError` for a fit without covariance or without noise, for a name that is none of its numbers or
    one of a `PhysicalInertia`, which depends on others, for values that are not finite, out of bounds or given twice,
    and for a function that does not have the residual of the fit.

    **Warns:** where the profile does not rise to the threshold of 95 % on some side, as where the data do not determine
    the number, and where some refit is better than the fit.
    """
    kinds = Callable | Experiment | list | tuple
    require_type(function, kinds, "function", "give what was fitted, a function of (params, *args) or experiments")
    function = ByValue.each(function)
    require_type(found, Fit, "found", "give what linkax.fit returned")
    spread = found.determined()
    if not spread.noise > 0.0:
        raise ValueError("the fit is exact, so that its residual tells of no noise; profile one of data with noise")
    require_type(args, list | tuple, "args", "give a tuple of what else the function gets")
    data = as_arrays(tuple(args), "args")
    if not callable(function):
        function, data = _of_experiments(function, found, args)
    whole_number(steps, "steps")
    tolerance = checked_tolerance(tolerance)
    index, entry = _place(found, spread.free, name)
    if values is None:
        places = _default_places(spread, entry, whole_number(count, "count", least=3))
    else:
        places = _places_of(spread.free, spread.z, index, entry, _checked(values), name)
    given = LevenbergMarquardt(tolerance, spread.free), function, spread.free, None, False
    with compiling():
        again, _ = sensitivity(Squares(*given), spread.z, data)
    _check_same(float(0.5 * again @ again), found.loss, len(found.residual))
    z, losses, ended = search_from_each(_Held(*given, entry), _starts(spread, entry, places), data, steps, None)
    z = jnp.asarray(z).at[:, entry].set(places)  # but for rounding they are there
    params = jax.tree.map(np.asarray, jax.vmap(spread.free.params)(z))
    numbers = np.asarray(jax.vmap(spread.free.vector)(z)[:, index])
    order = np.argsort(numbers)
    result = Profile(
        name=name,
        best=float(np.asarray(spread.free.vector(spread.z))[index]),
        values=numbers[order],
        losses=losses[order],
        params=jax.tree.map(lambda leaf: leaf[order], params),
        converged=(np.array(ended) == "converged")[order],
        loss=found.loss,
        noise=_unit(spread, entry),
        freedom=spread.freedom,
        bounds=_reached(spread, index, entry, z[:, entry]),
    )
    _warn(result)
    return result


def _of_experiments(experiments, found, args):
    """The residual of experiments, and its argument."""
    if len(args):
        raise ValueError(f"args are {args!r}; give them to the experiments, linkax.Experiment(..., args=)")
    if found.noises is None:
        raise ValueError("function is experiments, and found the fit of a function; give that one")
    return Laboratory.of(experiments, found.params).together, (as_arrays(found.noises, "noises"),)


def _place(found, free, name) -> tuple[int, int]:
    """Index of a number, and of the free number that it is a function of."""
    if name not in found.names:
        raise ValueError(f"name is {name!r}; known: {', '.join(map(repr, found.names))}")
    index = found.names.index(name)
    if not free.apart[index]:
        raise ValueError(f"{name!r} is one of several numbers that depend on each other; choose another parameter")
    return index, free.free_names.index(name)


def _checked(values) -> Float[np.ndarray, " n"]:
    array = np.asarray(real(values, "values"))
    right = lambda array: is_finite(array) and array.ndim == 1 and array.size > 0
    found = np.asarray(require(array, right, "values", "give a list of finite numbers"))
    if len(np.unique(found)) < len(found):
        raise ValueError(f"values are {found.tolist()}, of which some come twice; give each once")
    return found


def _default_places(spread, entry, count):
    """Of the free number: on both sides of the fit, within its ends; from a bound to one side."""
    width, side, here = WIDTH * spread.half_width(LEVEL)[entry], spread.sides[entry], float(spread.z[entry])
    width = width if np.isfinite(width) else UNKNOWN
    lower, upper = (float(end[entry]) for end in spread.free.ends)
    first, last = max(here - width, min(here, lower + NEAREST)), min(here + width, max(here, upper - NEAREST))
    if not side:
        return jnp.linspace(first, last, count)
    # Close to the bound the root rises as that of the distance. Of a logarithm, the width is in units of the number.
    steps = np.linspace(0.0, 1.0, count) ** 2
    if np.isfinite(spread.free.longest[entry]):
        return here + jnp.log1p(width * steps)
    return here + jnp.asarray(steps * (first - here if side > 0 else last - here))


def _reached(spread, index, entry, places) -> tuple[float, float]:
    """The bounds of a number that are reached, by the fit or by places of the free number."""
    found = []
    for sign, ends, bounds in zip((-1, 1), spread.free.ends, spread.free.bounds, strict=True):
        reached = spread.sides[entry] == sign or np.any(np.abs(places - ends[entry]) <= 2.0 * NEAREST)
        found.append(float(bounds[index]) if reached else sign * np.inf)
    lower, upper = found
    return lower, upper


def _places_of(free, z, index, entry, values, name):
    """Of the free number, at values of the number."""
    _, unravel = ravel_pytree(free.params(z))
    here = free.vector(z)
    places = jax.vmap(lambda value: free.at(unravel(here.at[index].set(value)))[entry])(jnp.asarray(values))
    for value, place in zip(values, np.asarray(places), strict=True):
        if not np.isfinite(place):
            raise ValueError(f"values hold {value}, which {name!r} cannot be; keep them within its bounds")
    return places


def _starts(spread, entry, places) -> Float[Array, "n p"]:
    """The free numbers, the others where the covariance puts them."""
    variance = spread.of_free[entry, entry]
    along = spread.of_free[:, entry] / variance if variance else np.zeros(len(spread.z))
    along[entry] = 1.0
    return spread.z + jnp.outer(places - spread.z[entry], jnp.asarray(along))


def _unit(spread, entry) -> float:
    """Standard deviation of a free number, over what the curvature of the loss makes it for noise of one."""
    curved = spread.unscaled[entry, entry]
    return float(np.sqrt(spread.of_free[entry, entry] / curved)) if curved else spread.noise


def _check_same(loss, fitted, count):
    if not np.isclose(loss, fitted, rtol=1e-6, atol=ROUNDING**2 * count):
        raise ValueError(
            f"function has the loss {one(loss)} at the fitted parameters, and the fit {one(fitted)}; give the residual "
            "and the args that were fitted, or the experiments"
        )


def _warn(result: Profile):
    """Warn where a profile is flat, or lower than the fit."""
    lowest = np.min(result.losses[result.converged], initial=np.inf)
    if lowest < result.loss - BETTER * result.noise**2:
        warn(
            f"a refit of the profile of {result.name!r} has the loss {one(lowest)}, the fit {one(result.loss)}: fit "
            "again from there"
        )
    lower, upper = result.interval(LEVEL)
    for end, side in ((lower, "below"), (upper, "above")):
        if np.isinf(end):
            warn(
                f"the profile of {result.name!r} does not rise to the threshold of 95 % {side} {one(result.best)}: "
                "give values further away; where it stays flat, the data do not determine the number"
            )
