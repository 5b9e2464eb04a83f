"""Find the experiment that determines parameters best, by gradients of the Fisher information."""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from linkax.model.numbers import number, one_of, require, require_type, whole_number
from linkax.studies.fits.design_result import Design
from linkax.studies.fits.fit import check_output
from linkax.studies.laboratory.experiments import Experiment, Experiments, checked_experiments
from linkax.studies.parameters.free_parameters import FreeParameters, has_prior
from linkax.studies.parameters.parameters import Bounded, Positive
from linkax.studies.parameters.uncertainty import Scatter, uncertainty
from linkax.xla.arrays import Array
from linkax.xla.users_line import warn
from linkax.xla.waiting import Progress, compiling
from scalarjit.code import ByValue

Criterion = Literal["D", "A", "E"]
CRITERIA = ("D", "A", "E")
WORSE = 100.0  # logarithm of the standard errors of a design whose run failed, above the largest that did not
REACHED = 1e-4  # of a limit, or of the range between bounds, up to which a design is at it
ENDED = {0: "converged", 4: "limits not met", 9: "out of steps"}  # by SciPy's status; others found no better step
NO_OPTIMUM = {
    "at an edge": "the standard errors would fall further where the run fails; limit the design, or start elsewhere",
    "no better step": "no step lowers the standard errors, although their gradient is not zero, as where they have a "
    "kink or the run is inaccurate; try a tighter accuracy, or another start",
    "limits not met": "no design that was tried meets the limits; start nearer to one that does, or widen them",
}


class _Planned(eqx.Module):
    """Predictions of experiments: (params, design) -> what `Experiment.planned` returns, for each."""

    together: Experiments

    def __call__(self, params: Any, design: Any) -> list[dict[str, Array]]:
        return self.together.planned(params, design)


class _Experiment(eqx.Module):
    """Predictions and limits as functions of free numbers: z of the parameters, and x of the design."""

    predictions: Callable
    limits: Callable | None
    free: FreeParameters
    choices: FreeParameters

    def predicted(self, z: Float[Array, " p"], x: Float[Array, " d"]) -> Float[Array, " n"]:
        return ravel_pytree(self.predictions(self.free.params(z), self.choices.params(x)))[0]

    def excess(self, x: Float[Array, " d"]) -> Any:
        """What must not be positive, as `limits` returns it."""
        return {} if self.limits is None else self.limits(self.free.params(self.free.start), self.choices.params(x))


# Programs of their own: what differentiates the simulation twice takes minutes to compile, and depends on no criterion.
@eqx.filter_jit
def _sensitivities(predictions, free, choices, x):
    """Of the predictions by relative changes of the parameters, (n, p), and their derivative by x, (n, p, d)."""
    experiment = _Experiment(predictions, None, free, choices)

    def slopes(x):
        found = jax.jacfwd(experiment.predicted)(free.start, x)
        return found, found

    bends, slopes = jax.jacfwd(slopes, has_aux=True)(x)
    return slopes, bends


@eqx.filter_jit
def _sized(criterion, matters, slopes, bends):
    """Log size of the standard errors, and its gradient."""
    size, along = jax.value_and_grad(lambda slopes: _log_size(slopes, criterion, matters))(slopes)
    return size, jnp.einsum("np,npd->d", along, bends)


def _log_size(slopes, criterion, matters):
    """Logarithm of the relative standard errors, by a criterion."""
    norms = jnp.linalg.norm(slopes, axis=0)
    inverse = jnp.linalg.inv(jnp.linalg.qr(slopes / norms, mode="r")) / norms[:, None]
    rows = inverse[jnp.array(matters)]
    covariance = rows @ rows.T
    if criterion == "D":
        return jnp.linalg.slogdet(covariance)[1] / (2 * len(matters))
    if criterion == "A":
        return 0.5 * jnp.log(jnp.trace(covariance) / len(matters))
    return 0.5 * jnp.log(jnp.linalg.eigvalsh(covariance)[-1])


@eqx.filter_jit
def _limited(experiment, x):
    """What must not be positive, and its derivative."""

    def excess(x):
        found = ravel_pytree(experiment.excess(x))[0]
        return found, found

    slopes, found = jax.jacfwd(excess, has_aux=True)(x)
    return found, slopes


class _Evaluation(NamedTuple):
    """Of one design: log size of the standard errors, excess over the limits, their derivatives, sensitivities."""

    log_size: Float[np.ndarray, ""]
    gradient: Float[np.ndarray, " d"]
    excess: Float[np.ndarray, " m"]
    excess_slopes: Float[np.ndarray, "m d"]
    slopes: Float[np.ndarray, "n p"]

    @property
    def ok(self) -> bool:
        return all(np.all(np.isfinite(part)) for part in self)


class _Search:
    """What SciPy asks of designs: each is computed once, and one whose run fails counts as far worse than all others.

    - `best`: (log size, x, evaluation) of the best design that meets the limits; None before there is one.
    - `history`: log size at the start of each step. `failed`: number of runs; `failed_before`: this step.
    """

    def __init__(
        self, experiment: _Experiment, criterion: Criterion, matters: tuple[int, ...], tolerance: float
    ) -> None:
        self.experiment, self.criterion, self.matters, self.tolerance = experiment, criterion, matters, tolerance
        self.x, self.last, self.best = None, None, None
        self.highest, self.failed, self.failed_before, self.ok = -np.inf, 0, 0, True
        self.history = []

    def at(self, x: Float[np.ndarray, " d"]) -> _Evaluation:
        """The evaluation of a design."""
        if self.x is None or not np.array_equal(x, self.x):
            self.x, found = np.array(x), self._evaluated(jnp.asarray(x))
            self.ok = found.ok
            if self.ok:
                self._keep(found)
            elif self.last is not None:
                self.failed += 1
                found = self.last._replace(log_size=np.asarray(self.highest + WORSE))
            self.last = found
        assert self.last is not None
        return self.last

    def _evaluated(self, x):
        of = self.experiment
        slopes, bends = _sensitivities(of.predictions, of.free, of.choices, x)
        parts = *_sized(self.criterion, self.matters, slopes, bends), *_limited(of, x), slopes
        return _Evaluation(*map(np.asarray, parts))

    def step_from(self, x: Float[np.ndarray, " d"]) -> _Evaluation:
        """The evaluation of a design from which a step goes on."""
        found = self.at(x)
        if self.ok:
            self.history.append(float(found.log_size))
            self.failed_before = self.failed
        return found

    def _keep(self, found):
        value = float(found.log_size)
        self.highest = max(self.highest, value)
        if np.all(found.excess <= self.tolerance) and (self.best is None or value < self.best[0]):
            self.best = value, self.x, found


def design(
    predictions: Callable | Experiment | Sequence[Experiment],
    params: Any,
    design: Any,
    *,
    limits: Callable | None = None,
    criterion: Criterion = "D",
    of: str | Sequence[str] | None = None,
    steps: int = 100,
    tolerance: int | float = 1e-6,
    progress: bool | None = None,
) -> Design:
    """Find the experiment that determines parameters best, under limits: excitation, start, where sensors are.

    The covariance of parameters, fitted to measurements with independent noise, is the inverse of the Fisher
    information Jᵀ J, where J are the sensitivities of the predictions. Sequential quadratic programming (Kraft, A
    software package for sequential quadratic programming, 1988; `scipy.optimize.minimize`) makes it small in the
    relative parameters, by gradients that are derivatives of derivatives of the simulation, forwards, and as accurate
    as its steps: 1e-6 or finer is well. It finds a local optimum, so try several starts.

    **Arguments:**

    - `predictions`: (params, design) -> what is measured, arrays in any pytree, each divided by the standard deviation
      of its noise. What is known of a parameter beforehand is one more prediction: the parameter over its standard
      deviation. Or a `linkax.Experiment`, or a list of them, whose model and sensors are functions of (params, design,
      *args), and whose record says when they tell something.
    - `params`: pytree of numbers and arrays, the parameters as they are thought to be, as for `linkax.fit`. Standard
      errors are relative to them; to one, for a parameter that is zero.
    - `design`: pytree of numbers and arrays, where the search starts; `linkax.Bounded` and `linkax.Positive` among them
      keep them in range. Others change in units of their start, and of one where that is zero.
    - `limits`: (params, design) -> arrays in any pytree, none of which may be positive, and of the order of one: such
      as {"torque": peak / 5.0 - 1.0}.
    - `criterion`: what shall be small of the relative standard errors: "D", the volume of the ellipsoid of confidence,
      as the geometric mean of its half axes; "A", the root of their mean square; "E", the longest half axis.
    - `of`: names of the parameters that matter; others, such as offsets of sensors, are unknown and do not. By default
      all.
    - `steps`: largest number of steps. `tolerance`: relative gain at which the search ends, and excess over a limit
      that is allowed.
    - `progress`: whether to show a progress bar; by default where the output is a terminal.

    **Returns:** a `Design`, the best one that meets the limits. Designs whose run fails are left aside.

    **Raises:** `ValueError` for params and designs that are not numbers, or have a prior, for sensors without noise,
    for predictions and limits that are none or are not finite where the search starts, and for parameters that the
    first design does not determine, by name.

    **Warns:** where the search ended in no optimum, and where no design met the limits.
    """
    kinds = Callable | Experiment | list | tuple
    require_type(predictions, kinds, "predictions", "give a function of (params, design), or experiments")
    predictions, limits = ByValue.each((predictions, limits))
    if not callable(predictions):
        predictions = _Planned(Experiments.of(checked_experiments(predictions)))
    if limits is not None:
        require_type(limits, Callable, "limits", "give a function of (params, design), or None")
    one_of(criterion, CRITERIA, "criterion")
    whole_number(steps, "steps")
    positive = lambda x: x > 0.0
    tolerance = float(require(number(tolerance, (), "tolerance"), positive, "tolerance", "it must be positive"))
    free = FreeParameters.of(_without_bounds(params))
    if free.num_priors:
        told = "give its number, and add number / standard deviation to the predictions"
        raise ValueError(f"params hold a parameter with a prior, {', '.join(map(repr, free.names))}; {told}")
    choices = FreeParameters.of(design)
    if choices.num_priors:
        given = [name for name, leaf in zip(choices.leaf_names, choices.leaves, strict=True) if has_prior(leaf)]
        raise ValueError(
            f"design holds what has a prior, {', '.join(map(repr, given))}, and a design is free; give a number, or "
            "linkax.Bounded"
        )
    matters = _chosen(of, free)
    experiment = _Experiment(predictions, limits, free, choices)
    names = _checked_outputs(experiment)
    search, start = _Search(experiment, criterion, matters, tolerance), np.asarray(choices.start)
    with compiling():
        first = search.at(start)
    before = _covariance(experiment, first)
    _check_start(search, first, before, names)
    status = _minimised(search, start, steps, progress)
    ended = _ending(search, status)
    x, last = (search.x, search.last) if search.best is None else search.best[1:]
    assert x is not None
    assert last is not None
    result = Design(
        design=jax.tree.map(np.asarray, choices.params(jnp.asarray(x))),
        params=jax.tree.map(np.asarray, free.params(free.start)),
        names=free.names,
        covariance=_covariance(experiment, last).covariance,
        covariance_before=before.covariance,
        criterion=criterion,
        history={"criterion": np.exp(search.history)},
        limits=dict(zip(names, map(float, last.excess), strict=True)),
        active=_active(choices, x, names, last.excess),
        steps=len(search.history) - 1,
        failed=search.failed,
        ended=ended,
    )
    if ended in NO_OPTIMUM:
        warn(f"the search for a design ended {ended!r}: {NO_OPTIMUM[ended]}")
    return result


def _without_bounds(params):
    """Numbers in place of what bounds them."""
    is_bounded = lambda node: isinstance(node, Bounded | Positive)
    return jax.tree.map(lambda leaf: leaf.value if is_bounded(leaf) else leaf, params, is_leaf=is_bounded)


def _chosen(of, free) -> tuple[int, ...]:
    """Indices of the free numbers that matter."""
    names = free.free_names
    if of is None:
        return tuple(range(len(names)))
    wanted = [of] if isinstance(of, str) else list(of)
    leaf = lambda name: name.split("[")[0]
    for name in wanted:
        if name not in names and name not in map(leaf, names):
            raise ValueError(f"of names {name!r}; known parameters: {', '.join(map(repr, names))}")
    if not wanted:
        raise ValueError("of is empty; name at least one parameter, or give None for all")
    return tuple(index for index, name in enumerate(names) if name in wanted or leaf(name) in wanted)


def _checked_outputs(experiment) -> list[str]:
    """Names of the limits; an error where predictions or limits are no real numbers."""
    first = experiment.free.params(experiment.free.start), experiment.choices.params(experiment.choices.start)
    shape = eqx.filter_eval_shape(experiment.predictions, *first)
    check_output(shape, "predictions")
    count, size = sum(np.size(leaf) for leaf in jax.tree.leaves(shape)), len(experiment.free.start)
    if count < size:
        raise ValueError(f"predictions returned {count} numbers, which cannot determine {size} parameters; give more")
    if experiment.limits is None:
        return []
    shape = eqx.filter_eval_shape(_Experiment.excess, experiment, experiment.choices.start)
    check_output(shape, "limits")
    return FreeParameters.of(jax.tree.map(lambda leaf: np.zeros(leaf.shape), shape)).names


def _covariance(experiment, found):
    """Covariance of the parameters, and those that are not determined, by sensitivities to noise of one."""
    finite = np.where(np.isfinite(found.slopes), found.slopes, 0.0)
    scatter = Scatter(1.0, np.ones(len(finite)))
    return uncertainty(np.zeros(len(finite)), finite, experiment.free, experiment.free.start, scatter)


def _check_start(search, first, before, names):
    """Whether a search can begin."""
    look = "look at solution.result of a single run with it"
    if not np.all(np.isfinite(first.slopes)):
        raise ValueError(
            "predictions or their derivatives are not finite at the design where the search starts; start elsewhere, "
            f"or {look}"
        )
    for name, value in zip(names, first.excess, strict=True):
        if not np.isfinite(value):
            raise ValueError(
                f"limits: {name!r} is {value} at the design where the search starts; start elsewhere, or {look}"
            )
    if before.undetermined:
        raise ValueError(
            f"predictions do not determine {', '.join(map(repr, before.undetermined))} with the design where the "
            "search starts: start with one that excites all parameters, fix some, or add what is known of them to the "
            "predictions"
        )
    if not search.ok:
        raise ValueError(
            "predictions or limits have no second or first derivative by the design where the search starts; start "
            "elsewhere"
        )


def _minimised(search, start, steps, progress) -> int:
    """Search from a start, and tell SciPy's status."""
    from scipy.optimize import minimize  # SciPy takes its time

    conditions = {
        "type": "ineq",
        "fun": lambda x: -search.at(x).excess,
        "jac": lambda x: -search.at(x).excess_slopes,
    }
    with Progress(steps, "step", progress) as line:

        def gradient(x):
            found = search.step_from(x)
            told = f", relative standard errors {np.exp(found.log_size):.4g}"
            line.tell("designing", len(search.history) - 1, told)
            return found.gradient

        found = minimize(
            lambda x: float(search.at(x).log_size),
            start,
            jac=gradient,
            bounds=np.stack(search.experiment.choices.ends, axis=1),
            constraints=[conditions] * bool(search.last.excess.size),
            method="SLSQP",
            options={"maxiter": steps, "ftol": search.tolerance},
        )
    if search.ok:  # SciPy asks no gradient where it ends
        search.history.append(float(search.at(found.x).log_size))
    return found.status


def _ending(search, status) -> str:
    """How a search ended, as in `linkax.Design`."""
    if search.best is None:
        return "limits not met"
    if status != 9 and search.failed > search.failed_before:
        return "at an edge"
    return ENDED.get(status, "no better step")


def _active(choices, x, names, excess) -> list[str]:
    """Limits that are reached, and numbers of the design that are at a bound."""
    active = [name for name, value in zip(names, excess, strict=True) if value >= -REACHED]
    for side, ends in zip(("lower", "upper"), choices.ends, strict=True):
        at_end = np.abs(x - np.asarray(ends)) <= REACHED
        active += [f"{name}, {side} bound" for name, there in zip(choices.free_names, at_end, strict=True) if there]
    return active
