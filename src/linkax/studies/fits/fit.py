"""Fit parameters to measurements, by gradients, and estimate their uncertainty."""

import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Bool, Int

from linkax.model.numbers import require_type, whole_number
from linkax.studies.fits.fit_result import Fit, Starts, doubts
from linkax.studies.fits.fit_search import (
    ASIDE,
    AbstractSearch,
    Descent,
    Mode,
    Squares,
    checked_tolerance,
    checkpoint_path,
    run_search,
    search_from_each,
    sensitivity,
)
from linkax.studies.fits.levenberg_marquardt import LevenbergMarquardt, LinearModel
from linkax.studies.laboratory.experiments import Experiment
from linkax.studies.laboratory.laboratory import FITTED, Laboratory
from linkax.studies.parameters.free_parameters import NEAREST, FreeParameters
from linkax.studies.parameters.parameters import as_arrays
from linkax.studies.parameters.uncertainty import NO_INFLUENCE, uncertainty
from linkax.xla.users_line import warn
from linkax.xla.waiting import compiling
from scalarjit.code import ByValue

if TYPE_CHECKING:
    from optax import GradientTransformation
else:
    GradientTransformation = Any  # optax takes its time

DEFAULT_STEPS = {"residual": 100, "loss": 1000}
DEFAULT_TOLERANCE = 1e-6
SETTLED_ENDS = "converged", "stopped early"
AT_END = 1e-4  # of the range between bounds, up to which a number is on one, of a loss
SETTLED = 1e-2  # relative change of the noise of sensors, from which on it stays as it is found
ROUNDS = 10  # of finding it
THERE = 1e-5  # change of a free number, relative to its magnitude, up to which a search was where it ended
FAR = 0.1  # from a minimum, in standard errors, up to which a search may have converged
DEFAULT_RATE = 0.02  # of Adam, in parameters that all start near one
NO_MINIMUM = {
    "at an edge": "the loss would fall further where the function is not finite, as where no state can be assembled; "
    "start elsewhere, keep parameters in `linkax.Bounded`, or look whether the model can give these data",
    "no derivative": "the function is finite at these parameters, and its derivative is not, as that of a square root "
    "at zero; start elsewhere, or write it such that it has one",
    "no better step": "the loss has a slope where it ended, as where the function has a kink, a run is inaccurate, or "
    "tolerances of an optimiser are large beside the residual; try a tighter accuracy, or another start",
}


def fit(
    function: Callable | Experiment | Sequence[Experiment],
    params: Any,
    args: tuple | list = (),
    *,
    optimiser: optx.AbstractLeastSquaresSolver | GradientTransformation | None = None,
    steps: int | None = None,
    tolerance: int | float = DEFAULT_TOLERANCE,
    patience: int | None = None,
    mode: Mode | None = None,
    checkpoint: str | os.PathLike | None = None,
    progress: bool | None = None,
    starts: Any = None,
) -> Fit:
    """Find the parameters that minimise a residual's sum of squares, or a loss.

    **Arguments:**

    - `function`: (params, *args) -> a residual, arrays in any pytree whose sum of squares is minimised; or a loss, one
      number. Divide a residual by the standard deviation of its noise to weigh each measurement by what it is worth.
      Several experiments are several parts of a residual; unknown initial states are parameters. Or a
      `linkax.Experiment`, or a list of them.
    - `params`: pytree of numbers and arrays, where the fit starts; `Positive`, `Bounded` and `PhysicalInertia` among
      them keep numbers physical, `Normal` and `LogNormal` say what is known beforehand. Each number is fitted in units
      of its start.
    - `args`: further arguments of the function, usually the measurements; others of the same shapes reuse the compiled
      program.
    - `optimiser`: for a residual, a least-squares solver of optimistix, by default Levenberg and Marquardt's method
      with damping relative to the sensitivities; for a residual or a loss, one of optax, for a loss by default
      `optax.adam`.
    - `steps`: largest number of steps; by default 100 for a residual, 1000 for a loss; of all searches together, where
      the noise of sensors is found, which takes several.
    - `tolerance`: part of the residual that a further step should take away, at which Levenberg-Marquardt ends;
      relative gain of the loss from which a step of optax counts as a gain.
    - `patience`: number of steps without gain after which the fit ends; by default unlimited.
    - `mode`: "forward" or "reverse" mode of derivatives; by default forward for a residual, and for a loss the cheaper
      one by the number of parameters.
    - `checkpoint`: a file, written at each step, from which the same fit goes on after it was killed or out of steps;
      with `starts` a second one beside it keeps theirs, "fit.starts.npz" beside "fit.npz".
    - `progress`: whether to show a progress bar; by default where the output is a terminal.
    - `starts`: what `params` are, with plain numbers and one axis before theirs: the fit searches from each, computed
      as one batch, and goes on from the best; `params` are then no start. `Fit.starts` tells where the others led; one
      that fails harms no other.

    **Returns:** a `Fit`.

    **Raises:** `ValueError` for parameters that are not numbers; for a function that returns none, or that is not
    finite or has no derivative where the fit starts; and for a checkpoint of another fit.

    **Warns:** of parameters that the data do not determine, or whose best value lies beyond a bound, where the fit
    ended at an edge, without derivative or without a better step, of noise of sensors that does not settle, and of
    channels that the model does not explain.
    """
    kinds = Callable | Experiment | list | tuple
    require_type(
        function, kinds, "function", "give a residual or a loss, a function of (params, *args), or experiments"
    )
    function, free = ByValue.each(function), FreeParameters.of(params)
    require_type(args, list | tuple, "args", "give a tuple of what else the function gets")
    data = as_arrays(tuple(args), "args")
    _check_ending(steps, patience)
    tolerance = checked_tolerance(tolerance)
    places = None if starts is None else free.starts(starts)
    laboratory = None
    if not callable(function):
        laboratory, function, data = _laboratory(function, free, args, checkpoint, places)
    is_loss = _is_loss(function, free, data)
    search = _search_by(optimiser, function, free, mode, is_loss, tolerance)
    steps = DEFAULT_STEPS["loss" if is_loss else "residual"] if steps is None else steps
    begin = free.start
    others = None
    if places is not None:
        begin, others = _best_start(search, places, data, steps, progress, checkpoint)
    z, losses, ended = run_search(search, data, steps, tolerance, patience, checkpoint, progress, begin)
    if laboratory is not None and laboratory.finds_noise:
        again = lambda data, z, left: run_search(search, data, left, tolerance, patience, None, progress, z)
        z, data, ended = _settled(again, search, laboratory, z, data, steps, losses, ended)
    if is_loss:
        result = _without_covariance(search, z, min(losses), None, losses, ended)
        on_bound = _named(search.free, _near_ends(search.free, z))
        result = result._replace(on_bound=on_bound, undetermined=_still(search, z, begin, data, losses, on_bound))
    else:
        result = _fit_of_residual(search, z, data, losses, ended, tolerance, laboratory)
    _warn(result)
    return result._replace(starts=others)


def _laboratory(experiments, free, args, checkpoint, starts) -> tuple[Laboratory, Callable, tuple]:
    """Experiments, their residual, and its argument: the noise that is found where the fit starts."""
    if len(args):
        raise ValueError(f"args are {args!r}; give them to the experiments, linkax.Experiment(..., args=)")
    laboratory = Laboratory.of(experiments, free.params(free.start))
    if laboratory.finds_noise and checkpoint is not None:
        raise ValueError(
            f"checkpoint is {checkpoint!r}; a fit that finds the noise keeps none: give all sensors a noise"
        )
    with compiling():
        noise = laboratory.first_noise([free.params(z) for z in ([free.start] if starts is None else starts)])
    return laboratory, laboratory.together, (noise,)


def _settled(again, search, laboratory, z, data, steps, losses, ended):
    """Find the noise by what a fit leaves, and fit again, in turn, until the noise stays as it is.

    **Arguments:** `again`: (data, z, steps left) -> what `run_search` returns; `losses`: so far, to which more come.

    **Warns:** where it does not.
    """
    for count in range(ROUNDS + 1):
        errors = laboratory.errors(search.free.params(z), FITTED)
        (before,) = data
        slopes = np.asarray(sensitivity(search, z, data)[1])
        if not np.all(np.isfinite(slopes)):
            break
        data = (laboratory.noise(errors, laboratory.lost(errors, before, slopes)),)
        changes = {name: np.max(np.abs(now / before[name] - 1.0)) for name, now in data[0].items()}
        name = max(changes, key=lambda name: changes[name])
        left = steps - len(losses)  # each search evaluates its start, too
        if changes[name] <= SETTLED or left < 0:
            ended = ended if changes[name] <= SETTLED else "out of steps"
            break
        if count == ROUNDS:
            warn(
                f"the noise of channel {name!r} still changes by {changes[name]:.1%} after {ROUNDS} fits in turn with "
                "it; give a noise to its sensor"
            )
            break
        z, more, ended = again(data, z, left)
        losses += more
    return z, data, ended


def _best_start(search, starts, data, steps, progress, checkpoint):
    """The best of several searches, and where all led.

    **Raises:** `ValueError` where none can begin.
    """
    beside = checkpoint
    if checkpoint is not None:
        path = checkpoint_path(checkpoint)
        beside = path.with_name(f"{path.stem}.starts{path.suffix}")
    every, losses, ended = search_from_each(search, starts, data, steps, progress, beside)
    if not np.any(np.isfinite(losses)):
        raise ValueError(f"the function is finite at none of {len(losses)} starts; give others")
    params = jax.tree.map(np.asarray, jax.vmap(search.free.params)(jnp.asarray(every)))
    return jnp.asarray(every[np.argmin(losses)]), Starts(params, losses, ended)


def _is_loss(function, free, args) -> bool:
    """Whether a function returns one number, and no array.

    **Raises:** `ValueError` where it returns nothing that can be minimised.
    """
    shape = eqx.filter_eval_shape(lambda z, args: function(free.params(z), *args), free.start, args)
    check_output(shape, "the function")
    return isinstance(shape, jax.ShapeDtypeStruct) and shape.shape == ()


def _search_by(optimiser, function, free, mode, is_loss, tolerance) -> AbstractSearch:
    """The search of an optimiser, or of the default one."""
    import optax

    if mode not in (None, "forward", "reverse"):
        raise ValueError(f"mode is {mode!r}; give 'forward', 'reverse', or None")
    if optimiser is None:
        optimiser = optax.adam(DEFAULT_RATE) if is_loss else LevenbergMarquardt(tolerance, free)
    by_squares = isinstance(optimiser, optx.AbstractLeastSquaresSolver)
    if not by_squares:
        known_ones = "give one of optax, such as optax.adam(1e-2), or a least-squares solver of optimistix"
        require_type(optimiser, optax.GradientTransformation, "optimiser", known_ones)
    if by_squares and is_loss:
        raise ValueError("least squares need a residual; this function returns one number, so give an optax optimiser")
    return (Squares if by_squares else Descent)(optimiser, function, free, mode, is_loss)


def _fit_of_residual(search, z, args, losses, ended, tolerance, laboratory) -> Fit:
    """The `Fit` of a residual, with covariance where the search may have ended in a minimum."""
    residual, slopes = (np.asarray(part) for part in sensitivity(search, z, args))
    if ended == "converged":
        ended = _checked_end(search, z, args, residual, slopes, tolerance)
    gradient = slopes.T @ residual
    pulled = _beyond_bounds(search.free, z, residual, slopes)
    loss = float(0.5 * residual @ residual)
    count = len(residual) - search.free.num_priors
    scatter = None
    there = np.ones(len(residual), bool)
    factors = np.ones(len(residual))
    if laboratory is not None:
        errors = laboratory.errors(search.free.params(z), FITTED)
        worth = laboratory.worth(errors, args[0], slopes)
        there[:count] = errors.there
        factors[:count] = worth.factors
        scatter = worth.scatter
    count = int(np.sum(there[:count]))
    seen = pulled | ~_hidden(search.free, z, residual, slopes)
    residual, slopes = residual[there], (factors[:, None] * np.where(seen, slopes, 0.0))[there]
    result = _without_covariance(search, z, loss, residual[:count], losses, ended)
    if laboratory is not None:
        result = result._replace(
            experiments=tuple(laboratory.experiments),
            noises=dict(args[0]),
            channels=laboratory.explained(errors, args[0]),
        )
    if ended in NO_MINIMUM:
        return result
    pulls = np.where(pulled, -gradient, 0.0) if ended in SETTLED_ENDS else None
    estimate = uncertainty(residual, slopes, search.free, z, scatter, pulls)
    return result._replace(
        on_bound=_named(search.free, estimate.spread.sides),
        covariance=estimate.covariance,
        noise=estimate.noise,
        undetermined=estimate.undetermined,
        spread=estimate.spread,
    )


def _beyond_bounds(free, z, residual, slopes) -> Bool[np.ndarray, " p"]:
    """Which free numbers are on a bound: by the slope of the loss and its curvature, its minimum lies beyond."""
    gradient = slopes.T @ residual
    sizes = np.linalg.norm(slopes, axis=0)
    lower, upper = map(np.asarray, free.ends)
    way = np.where(gradient > 0.0, np.minimum(z - lower, free.longest), upper - z)
    # Where no step leads closer to a bound, a number that is pulled there is on it.
    beyond = (gradient != 0.0) & ((way <= NEAREST) | (np.abs(gradient) / np.maximum(way, NEAREST) > sizes**2))
    # A logarithm that fell has lost its influence by that.
    fell = np.isfinite(np.asarray(free.longest)) & (np.asarray(z) < np.asarray(free.start))
    matters = (sizes > NO_INFLUENCE * np.max(sizes, initial=0.0)) & ~_hidden(free, z, residual, slopes)
    return beyond & (fell | matters)


def _hidden(free, z, residual, slopes) -> Bool[np.ndarray, " p"]:
    """Which free numbers a change as large as they are would change the residual by no more than its rounding."""
    change = np.linalg.norm(slopes, axis=0) * np.maximum(free.magnitudes(z), 1.0)
    return change <= np.finfo(float).eps * np.linalg.norm(residual)


def _near_ends(free, z) -> Int[np.ndarray, " p"]:
    """Of each free number: -1 and 1 where it is at its lower and its upper end, else 0."""
    lower, upper = (np.abs(np.asarray(z - end)) <= AT_END for end in free.ends)
    return upper.astype(int) - lower.astype(int)


def _still(search, z, begin, args, losses, on_bound) -> list[str]:
    """The names of those that no step has moved, since the loss has no slope there, although it is no minimum."""
    still = np.asarray(z == begin)
    names = search.free.free_names
    inside = [entry for entry in np.flatnonzero(still) if names[entry] not in on_bound]
    # Of all, there was no step, or each was too long.
    if not inside or (np.all(still) and (len(losses) == 1 or len(set(losses)) > 1)):
        return []
    flat = eqx.filter_jit(search.flat)
    loss = flat(z, args)[0]
    return [names[entry] for entry in inside if flat(z.at[entry].add(ASIDE), args)[0] <= loss]


def _named(free, sides) -> dict[str, str]:
    """The names of those that are on a bound, as in `Fit.on_bound`."""
    return {name: "lower" if side < 0 else "upper" for name, side in zip(free.free_names, sides, strict=True) if side}


def _without_covariance(search, z, loss, residual, losses, ended) -> Fit:
    return Fit(
        params=jax.tree.map(np.asarray, search.free.params(z)),
        loss=loss,
        residual=residual,
        names=search.free.names,
        covariance=None,
        noise=None,
        undetermined=[],
        on_bound={},
        history={"loss": np.array(losses)},
        steps=len(losses) - 1,
        ended=ended,
        spread=None,
        channels={},
    )


def _warn(result: Fit):
    """Warn where a fit ended in no minimum, where there are doubts, or data do not determine all parameters."""
    if result.ended in NO_MINIMUM:
        warn(f"the fit ended {result.ended!r}: {NO_MINIMUM[result.ended]}")
    for doubt in doubts(result):
        warn(doubt)
    if result.undetermined:
        warn(
            f"the data do not determine {', '.join(map(repr, result.undetermined))}: a small change of "
            f"{'it' if len(result.undetermined) == 1 else 'them together'} leaves the "
            f"{'loss' if result.residual is None else 'residual'} as it is; fix some, measure what they act on, or "
            "start elsewhere"
        )


def check_output(shape: Any, what: str) -> None:
    """Raise a ValueError where what a function returns, as shapes, are no numbers that have a derivative."""
    kinds = {}
    for path, leaf in jax.tree.leaves_with_path(shape):
        name = jax.tree_util.keystr(path) or "its value"
        try:
            size = np.prod(jnp.shape(leaf))
            kinds[name] = jnp.result_type(leaf)
        except TypeError as error:
            raise ValueError(f"{what} returned {leaf!r} in {name}; give real numbers") from error
        if size == 0:
            del kinds[name]
        elif jnp.issubdtype(kinds[name], jnp.complexfloating):
            raise ValueError(f"{what} returned complex numbers in {name}; give their real and imaginary parts")
    if not kinds:
        raise ValueError(f"{what} returned {shape!r}, no numbers; give some")
    if not any(jnp.issubdtype(kind, jnp.floating) for kind in kinds.values()):
        raise ValueError(
            f"{what} returned {next(iter(kinds.values()))} in {next(iter(kinds))}, which has no derivative; give "
            "floating-point numbers"
        )


def _checked_end(search, z, args, residual, slopes, tolerance) -> str:
    """How a search ended that says it has converged, by what an undamped step should gain and where it leads."""
    model = LinearModel.at(z, residual, slopes, search.free)
    step, gain = model.undamped(jnp.maximum(model.magnitudes, 1.0))
    loss = 0.5 * residual @ residual
    idle = gain <= max(tolerance, np.finfo(float).eps) * loss or loss <= model.rounding()
    if idle or np.all(np.abs(step) <= THERE * model.magnitudes):
        return "converged"
    if not np.all(np.isfinite(sensitivity(search, z + step, args)[0])):
        return "at an edge"
    variance = 2.0 * loss / max(len(residual) - len(z), 1)
    return "no better step" if 2.0 * gain > FAR**2 * variance else "converged"


def _check_ending(steps, patience):
    """Raise a ValueError where no search can end by these numbers."""
    if steps is not None:
        whole_number(steps, "steps", least=0)
    if patience is not None:
        whole_number(patience, "patience")
