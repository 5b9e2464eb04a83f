"""Parameters from measurements, by gradients, and how sure they are."""

import json
import os
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
from jax.flatten_util import ravel_pytree

from linkax.model.numbers import number, require, require_type, whole_number
from linkax.studies.files import writable_folder, written_whole
from linkax.studies.fingerprint import fingerprint
from linkax.studies.free_parameters import FreeParameters
from linkax.studies.levenberg_marquardt import LevenbergMarquardt
from linkax.studies.parameters import as_arrays
from linkax.studies.progress import progress_bar
from linkax.studies.uncertainty import DEPENDENT, uncertainty

DEFAULT_STEPS = {"residual": 100, "loss": 1000}
DEFAULT_TOLERANCE = 1e-6
DEFAULT_RATE = 0.02  # of Adam, in parameters that all start near one
NO_MINIMUM = {
    "at an edge": "the loss would fall further where the function is not finite, as where no state can be assembled; "
    "start elsewhere, keep parameters in `linkax.Bounded`, or look whether the model can give these data",
    "no derivative": "the function is finite at these parameters, and its derivative is not, as that of a square root "
    "at zero; start elsewhere, or write it such that it has one",
}
FEW = 3  # parameters up to which forward mode is cheaper than reverse mode


class Fit(NamedTuple):
    """What a fit found.

    - `params`: in the structure that was given, numbers in place of `Positive` and its like.
    - `loss`: the loss, or half the sum of squares of the residual. `residual`: at the end, (n,), or None.
    - `names`: of the p numbers in `params`, in the order of `covariance`.
    - `covariance`: of these numbers, (p, p), from the sensitivities of the residual and its own size; infinite for
      what the data do not determine; None for a loss, and where the fit ended at an edge or without derivative.
      `noise`: standard deviation of the residual.
    - `undetermined`: names of numbers that the data do not determine.
    - `history`: {"loss": at each step}. `steps`: taken.
    - `ended`: "converged", "stopped early", "diverged", or "out of steps"; "at an edge", beyond which the loss would
      fall but the function is not finite; "no derivative", where the function is finite and that is not.
    """

    params: Any
    loss: float
    residual: np.ndarray | None
    names: list[str]
    covariance: np.ndarray | None
    noise: float | None
    undetermined: list[str]
    history: dict[str, np.ndarray]
    steps: int
    ended: str
    spread: Callable

    @property
    def standard_errors(self):
        """Standard deviation of each number, in the structure of `params`."""
        _, unravel = ravel_pytree(self.params)
        return jax.tree.map(np.asarray, unravel(jnp.sqrt(jnp.diagonal(self._known_covariance()))))

    def interval(self, level=0.95):
        """Lower and upper ends of the confidence intervals of all numbers, each in the structure of `params`.

        From Student's t distribution. They keep to the bounds of `Positive` and `Bounded`.
        """
        self._known_covariance()
        if not 0.0 < level < 1.0:
            raise ValueError(f"level is {level!r}; it must lie between 0 and 1, such as 0.95")
        return self.spread(level)

    def _known_covariance(self):
        if self.covariance is None:
            raise ValueError(
                f"this fit has no covariance, it ended {self.ended!r}: fit a residual, whose sum of squares is the "
                "loss, and start where steps lead to a minimum"
            )
        return self.covariance


def fit(
    function: Callable,
    params: Any,
    args: tuple = (),
    *,
    optimiser: Any = None,
    steps: int | None = None,
    tolerance: float = DEFAULT_TOLERANCE,
    patience: int | None = None,
    mode: str | None = None,
    checkpoint: str | os.PathLike | None = None,
    progress: bool | None = None,
) -> Fit:
    """Find the parameters that make a residual or a loss smallest.

    **Arguments:**

    - `function`: (params, *args) -> a residual, arrays in any pytree whose sum of squares is to be smallest; or a
      loss, one number. A residual divided by the standard deviation of its noise counts every measurement for what
      it is worth. Several experiments are several parts of a residual, unknown initial states are parameters.
    - `params`: pytree of numbers and arrays, where the fit starts; `Positive`, `Bounded` and `PhysicalInertia` among
      them keep to what makes sense. Numbers are fitted in units of their own start.
    - `args`: what else the function gets, measurements above all: other ones of the same shapes compile nothing anew.
    - `optimiser`: for a residual an optimistix least-squares solver, default Levenberg and Marquardt's method with
      damping relative to the sensitivities; for either one of optax, default for a loss `optax.adam`.
    - `steps`: at most so many; default 100 for a residual, 1000 for a loss.
    - `tolerance`: of parameters and residual, relative, at which Levenberg-Marquardt ends; of the loss, relative, that
      a step of optax must gain to count as one that gains.
    - `patience`: end after so many steps that gain nothing; default never for optax.
    - `mode`: "forward" or "reverse", for derivatives; default by the number of parameters. A residual uses forward
      mode.
    - `checkpoint`: a file, written at each step, from which the same fit goes on, killed or out of steps.
    - `progress`: show a bar; default: where someone watches.

    **Returns:** a `Fit`.

    **Raises:** `ValueError` for parameters that are no numbers, for a function that returns none, that is not finite
    or has no derivative where the fit starts, and for a checkpoint of another fit.

    **Warns:** of parameters that the data do not determine; where the fit ended at an edge, or without derivative.
    """
    require_type(function, Callable, "function", "give a residual or a loss, a function of (params, *args)")
    free = FreeParameters.of(params)
    args = as_arrays(
        tuple(require_type(args, list | tuple, "args", "give a tuple of what else the function gets")), "args"
    )
    _check_ending(steps, tolerance, patience)
    shape = eqx.filter_eval_shape(lambda z, args: function(free.params(z), *args), free.start, args)
    _check_output(shape)
    is_loss = isinstance(shape, jax.ShapeDtypeStruct) and shape.shape == ()
    kind = "loss" if is_loss else "residual"
    if mode not in (None, "forward", "reverse"):
        raise ValueError(f"mode is {mode!r}; give 'forward', 'reverse', or None")
    if optimiser is None:
        optimiser = optax.adam(DEFAULT_RATE) if is_loss else LevenbergMarquardt(tolerance, tolerance)
    by_squares = isinstance(optimiser, optx.AbstractLeastSquaresSolver)
    if not by_squares:
        known_ones = "give one of optax, such as optax.adam(1e-2), or a least-squares solver of optimistix"
        require_type(optimiser, optax.GradientTransformation, "optimiser", known_ones)
    if by_squares and is_loss:
        raise ValueError("least squares need a residual; this function returns one number, so give an optax optimiser")
    search = (_Squares if by_squares else _Descent)(optimiser, function, free, mode, is_loss)
    steps = DEFAULT_STEPS[kind] if steps is None else steps
    z, losses, ended = _search(search, args, steps, tolerance, patience, checkpoint, progress)
    params = jax.tree.map(np.asarray, free.params(z))
    history = {"loss": np.array(losses)}
    if is_loss:
        _warn_of_no_minimum(ended)
        return Fit(params, min(losses), None, free.names, None, None, [], history, len(losses) - 1, ended, None)
    residual, slopes = (np.asarray(part) for part in _sensitivity(search, z, args))
    if ended == "converged" and _is_at_edge(search, z, args, residual, slopes, tolerance):
        ended = "at an edge"
    loss = float(0.5 * residual @ residual)
    if ended in NO_MINIMUM:
        _warn_of_no_minimum(ended)
        return Fit(params, loss, residual, free.names, None, None, [], history, len(losses) - 1, ended, None)
    found = uncertainty(residual, slopes, free, z)
    if found.undetermined:
        warnings.warn(
            f"the data do not determine {', '.join(map(repr, found.undetermined))}: a change of "
            f"{'it' if len(found.undetermined) == 1 else 'them together'} leaves the residual as it is; fix "
            "some, or measure what they act on",
            stacklevel=2,
        )
    return Fit(
        params,
        loss,
        residual,
        free.names,
        found.covariance,
        found.noise,
        found.undetermined,
        history,
        len(losses) - 1,
        ended,
        found.spread,
    )


def _warn_of_no_minimum(ended):
    if ended in NO_MINIMUM:
        warnings.warn(f"the fit ended {ended!r}: {NO_MINIMUM[ended]}", stacklevel=3)


def _check_output(shape):
    """Whether what the function returns, by `eqx.filter_eval_shape`, can be made small."""
    kinds = {}
    for path, leaf in jax.tree.leaves_with_path(shape):
        name = jax.tree_util.keystr(path) or "its value"
        try:
            size, kinds[name] = np.prod(jnp.shape(leaf)), jnp.result_type(leaf)
        except TypeError as error:
            raise ValueError(f"the function returned {leaf!r} in {name}; give real numbers") from error
        if size == 0:
            del kinds[name]
        elif jnp.issubdtype(kinds[name], jnp.complexfloating):
            raise ValueError(f"the function returned complex numbers in {name}; give their real and imaginary parts")
    if not kinds:
        raise ValueError(f"the function returned {shape!r}, no numbers; give a residual or a loss")
    if not any(jnp.issubdtype(kind, jnp.floating) for kind in kinds.values()):
        raise ValueError(
            f"the function returned {next(iter(kinds.values()))} in {next(iter(kinds))}, which has no derivative; give "
            "floating-point numbers"
        )


def _is_at_edge(search, z, args, residual, slopes, tolerance) -> bool:
    """Whether an undamped step, which promises to lower the loss, leads to where the function is not finite."""
    step = -np.linalg.lstsq(slopes, residual, rcond=DEPENDENT)[0]
    left = residual + slopes @ step
    gains = residual @ residual - left @ left > max(tolerance, np.finfo(float).eps) * (residual @ residual)
    return bool(gains and not np.all(np.isfinite(_sensitivity(search, z + step, args)[0])))


def _check_ending(steps, tolerance, patience):
    """Whether what ends a search makes sense."""
    if steps is not None:
        whole_number(steps, "steps", least=0)
    if patience is not None:
        whole_number(patience, "patience")
    require(
        number(tolerance, (), "tolerance"), lambda x: x >= 0.0, "tolerance", "it must be zero or more, such as 1e-6"
    )


def _linearised(function, z, mode="forward"):
    """A function's value and its Jacobian."""
    if mode == "reverse":
        value, back = jax.vjp(function, z)
        return value, jax.vmap(back)(jnp.eye(len(value), dtype=value.dtype))[0]
    value, along = jax.linearize(function, z)
    return value, jax.vmap(along, out_axes=-1)(jnp.eye(len(z), dtype=z.dtype))


class _AbstractSearch(eqx.Module):
    """Steps towards the smallest loss."""

    solver: Any
    function: Callable
    free: FreeParameters
    mode: str | None = eqx.field(static=True)
    is_loss: bool = eqx.field(static=True)

    def flat(self, z, args):
        """The residual, or the loss, as a vector."""
        return ravel_pytree(self.function(self.free.params(z), *args))[0]


@eqx.filter_jit
def _sensitivity(search, z, args):
    return _linearised(lambda z: search.flat(z, args), z, search.mode)


class _Squares(_AbstractSearch):
    """Steps of an optimistix least-squares solver."""

    def _residual(self):
        """With the Jacobian by forward mode as its reverse rule: so the solver keeps an array from step to step."""
        if self.mode == "reverse":
            return lambda z, args: (self.flat(z, args), None)

        def residual(z, args):
            flat = jax.custom_vjp(lambda z: self.flat(z, args))
            flat.defvjp(lambda z: _linearised(lambda z: self.flat(z, args), z), lambda slopes, along: (along @ slopes,))
            return flat(z), None

        return residual

    def begin(self, z, args):
        shape = jax.eval_shape(self.flat, z, args)
        return self.solver.init(self._residual(), z, args, {"jac": "bwd"}, shape, None, frozenset())

    def step(self, z, state, args):
        """The next z and state, the loss at z, whether its derivative is finite, and whether z is the answer."""
        z, state, _ = self.solver.step(self._residual(), z, args, {"jac": "bwd"}, state, frozenset())
        done, _ = self.solver.terminate(self._residual(), z, args, {"jac": "bwd"}, state, frozenset())
        smooth = jnp.all(jnp.isfinite(state.f_info.jac.as_matrix()))
        return z, state, 0.5 * jnp.sum(state.f_info.residual**2), smooth, done


class _Descent(_AbstractSearch):
    """Steps of an optax optimiser."""

    def begin(self, z, args):
        return self.solver.init(z)

    def step(self, z, state, args):
        """The next z and state, the loss at the last z, whether its derivative is finite, and False."""

        def loss(z):
            value = self.flat(z, args)
            return value[0] if self.is_loss else 0.5 * jnp.sum(value**2)

        forward = len(z) <= FEW if self.mode is None else self.mode == "forward"
        value, slope = _linearised(loss, z) if forward else jax.value_and_grad(loss)(z)
        solver = optax.with_extra_args_support(self.solver)
        update, state = solver.update(slope, state, z, value=value, grad=slope, value_fn=loss)
        return optax.apply_updates(z, update), state, value, jnp.all(jnp.isfinite(slope)), jnp.zeros((), bool)


@eqx.filter_jit
def _begin(search, z, args):
    return search.begin(z, args)


@eqx.filter_jit
def _step(search, z, state, args):
    return search.step(z, state, args)


def _search(search, args, steps, tolerance, patience, checkpoint, progress):
    """The best z, the loss at each step, and how the search ended."""
    z = search.free.start
    state = _begin(search, z, args)
    losses, best, best_z, waited = [], np.inf, z, 0
    kept = None if checkpoint is None else _Checkpoint.of(checkpoint, search, z, state, args)
    if kept is not None and kept.path.exists():
        (z, best_z, state), losses, waited = kept.load((z, best_z, state))
        best = min(losses)
    ended = "out of steps"
    with progress_bar(steps, "step", progress, initial=len(losses)) as bar:
        while len(losses) < steps + 1:
            before = z
            z, state, loss, smooth, done = _step(search, z, state, args)
            loss = float(loss)
            if not losses:
                _check_start(loss, smooth)
            losses.append(loss)
            # Squares tell the loss at z, descent that at the point before.
            here = z if isinstance(search, _Squares) else before
            waited = 0 if not np.isfinite(best) or loss < best - tolerance * abs(best) else waited + 1
            best, best_z = (loss, here) if loss <= best else (best, best_z)
            bar.set_description("fitting")
            bar.set_postfix(loss=f"{loss:.6g}")
            bar.update()
            if kept is not None:
                kept.save((z, best_z, state), losses, waited)
            if not np.isfinite(loss):
                ended = "diverged"
                break
            if not smooth:
                ended = "no derivative"
                break
            if done:
                ended = "converged"
                break
            if patience is not None and waited >= patience:
                ended = "stopped early"
                break
    return best_z, losses, ended


def _check_start(loss, smooth):
    """Whether a search can begin."""
    if not np.isfinite(loss):
        raise ValueError(
            "the function is not finite at the parameters where the fit starts: look at solution.result of a single "
            "run with them"
        )
    if not smooth:
        raise ValueError(
            "the function has no derivative at the parameters where the fit starts, as a square root has none at zero; "
            "start elsewhere, or ask `linkax.differentiability`"
        )


class _Checkpoint(NamedTuple):
    """A file of all that a search goes on from."""

    path: Path
    names: list[str]
    identity: str

    @staticmethod
    def of(path, search, z, state, args) -> "_Checkpoint":
        path = Path(require_type(path, str | os.PathLike, "checkpoint", "give the name of a file"))
        writable_folder(path.parent, f"give another checkpoint than {str(path)!r}")
        if path.is_dir():
            raise ValueError(f"checkpoint {str(path)!r} is a folder; give the name of a file")
        text = _step.lower(search, z, state, args).as_text()
        numbers = jax.tree.leaves(eqx.filter((search, z, args), eqx.is_array))
        return _Checkpoint(path, search.free.names, fingerprint(text, numbers))

    def save(self, tree, losses, waited):
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]
        with written_whole(self.path) as file, open(file, "wb") as stream:
            header = json.dumps({"names": self.names, "fit": self.identity, "losses": losses, "waited": waited})
            np.savez(stream, header=np.array(header), **{f"leaf_{i}": leaf for i, leaf in enumerate(leaves)})

    def load(self, like):
        arrays, static = eqx.partition(like, eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        try:
            with np.load(self.path) as file:
                header = json.loads(str(file["header"]))
                found = [file[f"leaf_{i}"] for i in range(len(file.files) - 1)]
        except (AttributeError, EOFError, KeyError, OSError, ValueError, zipfile.BadZipFile) as error:
            other = f"checkpoint {str(self.path)!r} holds something else than a fit"
            raise ValueError(f"{other}; give another file, or remove this one") from error
        if header.get("fit") != self.identity:
            raise ValueError(
                f"checkpoint {str(self.path)!r} holds another fit, of {', '.join(header['names'])} (parameters, their "
                "start or bounds, the data, the function, the optimiser or versions have changed); give another file, "
                "or remove this one"
            )
        found = [jnp.asarray(x, leaf.dtype) for x, leaf in zip(found, leaves, strict=True)]
        return eqx.combine(jax.tree.unflatten(structure, found), static), header["losses"], header["waited"]
