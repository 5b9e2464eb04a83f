"""Search for the parameters of smallest loss, step by step, with a file to go on from."""

import abc
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float

from linkax.files import writable_folder, written_whole
from linkax.model.numbers import number, require, require_type
from linkax.studies.fits.levenberg_marquardt import LinearModel
from linkax.studies.parameters.fingerprint import fingerprint
from linkax.studies.parameters.free_parameters import FreeParameters
from linkax.xla.arrays import Array
from linkax.xla.waiting import Progress, compiling

FEW = 3  # parameters up to which forward mode is cheaper than reverse mode
FAINT = 1e-6  # effect of a free number, relative to the largest or the residual, up to which its square may have more
ASIDE = 1e-2  # of a free number, to see whether it does
FURTHEST = 10.0  # times as far, that this tells of
Mode = Literal["forward", "reverse"]
Evaluation = tuple[Float[Array, " n"], Float[Array, "n p"]] | tuple[()]
Step = tuple[Float[Array, " p"], Any, Float[Array, ""], Bool[Array, ""], Bool[Array, ""]]


def _linearised(function, z, mode=None):
    """A function's value and its Jacobian, by forward mode unless `mode` is "reverse"."""
    if mode == "reverse":
        value, back = jax.vjp(function, z)
        return value, jax.vmap(back)(jnp.eye(len(value), dtype=value.dtype))[0]
    value, along = jax.linearize(function, z)
    return value, jax.vmap(along, out_axes=-1)(jnp.eye(len(z), dtype=z.dtype))


class AbstractSearch(eqx.Module):
    """Steps towards the smallest loss, in the vector z of `FreeParameters`.

    - `solver`: of optimistix or optax. `function`: (params, *args) -> a residual, or a loss where `is_loss`.
    - `mode`: of derivatives; None for the cheaper one.
    """

    solver: Any
    function: Callable
    free: FreeParameters
    mode: Mode | None = eqx.field(static=True)
    is_loss: bool = eqx.field(static=True)

    def flat(self, z: Float[Array, " p"], args: tuple) -> Float[Array, " n"]:
        """The residual and that of priors, or the loss with theirs, as a vector."""
        found = ravel_pytree(self.function(self.free.params(z), *args))[0]
        if not self.free.num_priors:
            return found
        prior = self.free.prior(z)
        return found + 0.5 * jnp.sum(prior**2) if self.is_loss else jnp.concatenate([found, prior])

    @abc.abstractmethod
    def tried(self, z: Float[Array, "..."], state: Any) -> Float[Array, "..."]:
        """Where the next step evaluates the function, of one search or several; `state`: None before there is one."""

    @abc.abstractmethod
    def evaluated(self, z: Float[Array, " p"], args: tuple) -> Evaluation:
        """What the next step needs that a program of its own computes, at `tried`."""

    @abc.abstractmethod
    def begin(self, z: Float[Array, " p"], found: Evaluation) -> Any:
        """The solver's state at z."""

    @abc.abstractmethod
    def step(self, z: Float[Array, " p"], state: Any, args: tuple, found: Evaluation) -> Step:
        """The next z and state, a loss, whether its derivative is finite, and whether the search has converged.

        The loss is that at the next z for `Squares`, and at this z for `Descent`.
        """

    @abc.abstractmethod
    def aside(
        self, z: Float[Array, " p"], args: tuple, found: Evaluation, tolerance: int | float
    ) -> tuple[Float[Array, " p"], Evaluation] | None:
        """Beside z, where no step leads away from it, a place of lower loss, and what is evaluated there."""


@eqx.filter_jit
def sensitivity(
    search: AbstractSearch, z: Float[Array, " p"], args: tuple
) -> tuple[Float[Array, " n"], Float[Array, "n p"]]:
    """The residual at z, and its derivative."""
    return _linearised(lambda z: search.flat(z, args), z, search.mode)


class Squares(AbstractSearch):
    """Steps of a least-squares solver of optimistix, by the residual and its Jacobian, which `sensitivity` computes."""

    def tried(self, z: Float[Array, "..."], state: Any) -> Float[Array, "..."]:
        return z if state is None else state.y_eval

    def evaluated(self, z: Float[Array, " p"], args: tuple) -> Evaluation:
        return sensitivity(self, z, args)

    def begin(self, z: Float[Array, " p"], found: Evaluation) -> Any:
        residual = cast(Any, found)[0]
        shape = jax.ShapeDtypeStruct(residual.shape, residual.dtype)
        return self.solver.init(_residual(*found), z, (), {"jac": "bwd"}, shape, None, frozenset())

    def step(self, z: Float[Array, " p"], state: Any, args: tuple, found: Evaluation) -> Step:
        given = (), {"jac": "bwd"}, state, frozenset()
        z, state, _ = self.solver.step(_residual(*found), z, *given)
        done, _ = self.solver.terminate(_residual(*found), z, *given[:2], state, frozenset())
        low, high = self.free.room(z)
        state = eqx.tree_at(lambda state: state.y_eval, state, z + jnp.clip(state.y_eval - z, low, high))
        smooth = jnp.all(jnp.isfinite(state.f_info.jac.as_matrix()))
        return z, state, 0.5 * jnp.sum(state.f_info.residual**2), smooth, done

    def aside(
        self, z: Float[Array, " p"], args: tuple, found: Evaluation, tolerance: int | float
    ) -> tuple[Float[Array, " p"], Evaluation] | None:
        # A damping that enters by its square, or an eccentricity, has no slope at zero, and the loss may fall along it.
        # There the residual is a function of its square: a slope by that is what it gains from a short way.
        residual, slopes = map(np.asarray, cast(Any, found))
        sizes, move = np.linalg.norm(slopes, axis=0), np.zeros_like(z)
        for entry in np.flatnonzero(sizes <= FAINT * np.maximum(np.max(sizes), np.linalg.norm(residual))):
            length = ASIDE if z[entry] + ASIDE <= self.free.ends[1][entry] else -ASIDE
            there, _ = sensitivity(self, jnp.asarray(z).at[entry].add(length), args)
            bent = np.asarray(there) - residual - length * slopes[:, entry]
            if residual @ bent < 0.0:
                move[entry] = length * np.minimum(np.sqrt(-residual @ bent / (bent @ bent)), FURTHEST)
        if not np.any(move):
            return None
        moved = z + jnp.clip(move, *self.free.room(z))
        lower = sensitivity(self, moved, args)
        gain = 0.5 * (residual @ residual - lower[0] @ lower[0])
        least = 0.5 * tolerance * residual @ residual + LinearModel.at(z, residual, slopes, self.free).rounding()
        return (moved, lower) if gain > least else None


def _residual(value, slopes):
    """A residual for the solver, known where it asks for it; with the Jacobian as a rule it keeps an array."""
    known = jax.custom_vjp(lambda z: value)
    known.defvjp(lambda z: (value, slopes), lambda slopes, along: (along @ slopes,))
    return lambda z, args: (known(z), None)


class Descent(AbstractSearch):
    """Steps of an optimiser of optax, which never tells that it has converged."""

    def tried(self, z: Float[Array, "..."], state: Any) -> Float[Array, "..."]:
        return z

    def evaluated(self, z: Float[Array, " p"], args: tuple) -> Evaluation:
        return ()

    def begin(self, z: Float[Array, " p"], found: Evaluation) -> Any:
        return self.solver.init(z)

    def step(self, z: Float[Array, " p"], state: Any, args: tuple, found: Evaluation) -> Step:
        import optax

        def loss(z):
            value = self.flat(z, args)
            return value[0] if self.is_loss else 0.5 * jnp.sum(value**2)

        forward = len(z) <= FEW if self.mode is None else self.mode == "forward"
        value, slope = _linearised(loss, z) if forward else jax.value_and_grad(loss)(z)
        low, high = self.free.room(z)
        slope = jnp.where(jnp.where(slope > 0.0, low, high) == 0.0, 0.0, slope)
        solver = optax.with_extra_args_support(self.solver)
        update, state = solver.update(slope, state, z, value=value, grad=slope, value_fn=loss)
        moved: Any = optax.apply_updates(z, update)
        low, high = self.free.room(z)
        moved = z + jnp.clip(moved - z, low, high)
        return moved, state, value, jnp.all(jnp.isfinite(slope)), jnp.zeros((), bool)

    def aside(
        self, z: Float[Array, " p"], args: tuple, found: Evaluation, tolerance: int | float
    ) -> tuple[Float[Array, " p"], Evaluation] | None:
        return None


@eqx.filter_jit
def _begin(search, z, found):
    return search.begin(z, found)


@eqx.filter_jit
def _step(search, z, state, args, found):
    return search.step(z, state, args, found)


def run_search(
    search: AbstractSearch,
    args: tuple,
    steps: int,
    tolerance: int | float,
    patience: int | None,
    checkpoint: str | os.PathLike | None,
    progress: bool | None,
    start: Float[Array, " p"],
) -> tuple[Float[Array, " p"], list[float], str]:
    """Search from z = `start`; see `linkax.fit` for the other arguments.

    **Returns:** the z of smallest loss, the loss at each step, and how the search ended, as in `linkax.Fit`.

    **Raises:** `ValueError` where the function is not finite or has no derivative at the start, and for a checkpoint
    of another fit.
    """
    z = start
    with compiling():
        found = search.evaluated(search.tried(z, None), args)
        z, found = search.aside(z, args, found, tolerance) or (z, found)
        state = _begin(search, z, found)
    losses, best, best_z, waited, ended = [], np.inf, z, 0, None
    programs = [(_step, (search, z, state, args, found))] + [(sensitivity, (search, z, args))] * bool(found)
    kept = None if checkpoint is None else _Checkpoint.of(checkpoint, search, z, args, programs)
    if kept is not None and kept.path.exists():
        (z, best_z, state), told = kept.load((z, best_z, state))
        losses, waited, ended = told["losses"], told["waited"], told["ended"]
        best, found = min(losses), None
    impatient = lambda: patience is not None and waited >= patience
    with Progress(steps, "step", progress) as line:
        while ended is None and not impatient() and len(losses) < steps + 1:
            before = z
            found = search.evaluated(search.tried(z, state), args) if found is None else found
            with compiling(not losses):
                z, state, loss, smooth, done = _step(search, z, state, args, found)
            loss, found = float(loss), None
            if not losses:
                _check_start(loss, smooth)
            losses.append(loss)
            here = z if isinstance(search, Squares) else before
            waited = 0 if not np.isfinite(best) or loss < best - tolerance * abs(best) else waited + 1
            best, best_z = (loss, here) if loss <= best else (best, best_z)
            line.tell("fitting", len(losses), f", loss {loss:.6g}")
            ended = _ending(loss, smooth, done)
            if ended == "converged":
                here = state.f_info.residual, state.f_info.jac.as_matrix()
                if (aside := search.aside(z, args, here, tolerance)) is not None:
                    z, found = aside
                    state, ended = _begin(search, z, found), None
            if kept is not None:
                kept.save((z, best_z, state), losses=losses, waited=waited, ended=ended)
    return best_z, losses, ended or ("stopped early" if impatient() else "out of steps")


@eqx.filter_jit
def _evaluated_each(search, z, args):
    return eqx.filter_vmap(lambda z: search.evaluated(z, args))(z)


@eqx.filter_jit
def _begin_each(search, z, found):
    return eqx.filter_vmap(search.begin)(z, found)


@eqx.filter_jit
def _step_each(search, z, state, args, found, active):
    over = eqx.if_array(0)
    step = lambda z, state, found: search.step(z, state, args, found)
    moved, later, *told = eqx.filter_vmap(step, in_axes=(0, over, over))(z, state, found)

    def kept(new, old):
        return jnp.where(active.reshape(-1, *(1,) * (new.ndim - 1)), new, old) if eqx.is_array(new) else new

    return kept(moved, z), jax.tree.map(kept, later, state), *told


def search_from_each(
    search: AbstractSearch,
    starts: Float[Array, "n p"],
    args: tuple,
    steps: int,
    progress: bool | None,
    checkpoint: Path | None = None,
) -> tuple[Float[np.ndarray, "n p"], Float[np.ndarray, " n"], list[str]]:
    """Search from several starts, computed together; one that fails harms no other.

    **Returns:** of each, the z of smallest loss, that loss, infinite where it could not begin, and how it ended.

    **Raises:** `ValueError` for a checkpoint of other searches.
    """
    z, ended, first = starts, [""] * len(starts), 0
    best_z, best = np.array(starts), np.full(len(starts), np.inf)
    with compiling():
        found = _evaluated_each(search, search.tried(z, None), args)
        state = _begin_each(search, z, found)
    active = np.ones(len(starts), bool)
    programs = [
        (_evaluated_each, (search, z, args)),
        (_step_each, (search, z, state, args, found, jnp.asarray(active))),
    ]
    kept = None if checkpoint is None else _Checkpoint.of(checkpoint, search, z, args, programs)
    if kept is not None and kept.path.exists():
        (z, state, *bests), told = kept.load((z, state, best_z, best))
        (best_z, best), found = map(np.array, bests), None
        ended, first = told["ended"], told["count"]
    with Progress(steps, "step", progress) as line:
        for count in range(first, steps + 1):
            active = np.array([not reason for reason in ended])
            if not np.any(active):
                break
            found = _evaluated_each(search, search.tried(z, state), args) if found is None else found
            before = z
            with compiling(count == first):
                z, state, loss, smooth, done = _step_each(search, z, state, args, found, jnp.asarray(active))
            here, loss, found = np.asarray(z if isinstance(search, Squares) else before), np.asarray(loss), None
            better = active & (loss <= best)
            best[better], best_z[better] = loss[better], here[better]
            for i in np.flatnonzero(active):
                ended[i] = _ending(loss[i], smooth[i], done[i]) or "out of steps" * (count == steps)
            line.tell("searching", count, f", {np.sum(~active)} of {len(active)} done, best loss {np.min(best):.6g}")
            if kept is not None:
                kept.save((z, state, best_z, best), ended=ended, count=count + 1)
    return best_z, best, ended


def _ending(loss, smooth, done) -> str | None:
    """How a search ends with this step, or None where it goes on."""
    if not np.isfinite(loss):
        return "diverged"
    if not smooth:
        return "no derivative"
    return "converged" if done else None


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


def checked_tolerance(tolerance: int | float) -> float:
    """Check how closely a search is to end."""
    not_negative = lambda x: x >= 0.0
    remedy = "it must be zero or more, such as 1e-6"
    return float(require(number(tolerance, (), "tolerance"), not_negative, "tolerance", remedy))


def checkpoint_path(path: str | os.PathLike) -> Path:
    """Check the name of a file."""
    return Path(require_type(path, str | os.PathLike, "checkpoint", "give the name of a file"))


class _Checkpoint(NamedTuple):
    """A file with all that a search needs to go on.

    - `names`: of the parameters. `fingerprint`: of the step's program and its numbers.
    """

    path: Path
    names: list[str]
    fingerprint: str

    @staticmethod
    def of(
        path: str | os.PathLike, search: AbstractSearch, z: Float[Array, "..."], args: tuple, programs: list[tuple]
    ) -> "_Checkpoint":
        """**Arguments:** `programs`: those of the search, each with its arguments."""
        path = checkpoint_path(path)
        writable_folder(path.parent, f"give another checkpoint than {str(path)!r}")
        if path.is_dir():
            raise ValueError(f"checkpoint {str(path)!r} is a folder; give the name of a file")
        text = "".join(cast(Any, program).lower(*given).as_text() for program, given in programs)
        numbers = jax.tree.leaves(eqx.filter((search, z, args), eqx.is_array))
        return _Checkpoint(path, search.free.names, fingerprint(text, numbers))

    def save(self, tree: Any, **told: Any) -> None:
        """Write the arrays of `tree`, and what else there is to tell, as JSON has it."""
        header = json.dumps({"names": self.names, "fit": self.fingerprint, **told})
        leaves = jax.tree.leaves(eqx.filter(tree, eqx.is_array))
        arrays: dict[str, Any] = {f"leaf_{i}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
        with written_whole(self.path) as file, open(file, "wb") as stream:
            np.savez(stream, header=np.array(header), **arrays)

    def load(self, like: Any) -> tuple[Any, dict[str, Any]]:
        """Read what `save` wrote; `like` is a tree of the same structure.

        **Raises:** `ValueError` for a file of something else.
        """
        arrays, static = eqx.partition(like, eqx.is_array)
        leaves, structure = jax.tree.flatten(arrays)
        try:
            with np.load(self.path) as file:
                header = json.loads(str(file["header"]))
                stored = [file[f"leaf_{i}"] for i in range(len(file.files) - 1)]
        except (AttributeError, EOFError, KeyError, OSError, ValueError, zipfile.BadZipFile) as error:
            other = f"checkpoint {str(self.path)!r} holds something else than a fit"
            raise ValueError(f"{other}; give another file, or remove this one") from error
        if header.get("fit") != self.fingerprint:
            raise ValueError(
                f"checkpoint {str(self.path)!r} holds another fit, of {', '.join(header['names'])} (parameters, their "
                "start or bounds, the data, the function, the optimiser or versions have changed); give another file, "
                "or remove this one"
            )
        stored = [jnp.asarray(x, leaf.dtype) for x, leaf in zip(stored, leaves, strict=True)]
        return eqx.combine(jax.tree.unflatten(structure, stored), static), header
