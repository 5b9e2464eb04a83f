"""Checks of the options of a run, most of them diffrax's own objects, before anything is compiled."""

from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.model.numbers import Number, positive, real, require, require_type, whole_number
from linkax.simulation.integrate.accuracy import Accuracy
from linkax.simulation.integrate.step_control import MechanismControl
from linkax.xla.arrays import Array, Scalar
from linkax.xla.tracing import concrete

Tree = TypeVar("Tree")

# What each option is, and what to give.
KINDS = {
    "saveat": (diffrax.SaveAt, "diffrax.SaveAt(ts=...)"),
    "solver": (diffrax.AbstractSolver, "diffrax.Dopri8()"),
    "stepsize_controller": (diffrax.AbstractStepSizeController, "diffrax.PIDController(rtol=..., atol=...)"),
    "adjoint": (diffrax.AbstractAdjoint, "diffrax.RecursiveCheckpointAdjoint()"),
    "event": (diffrax.Event, "diffrax.Event(...)"),
    "progress_meter": (diffrax.AbstractProgressMeter, "diffrax.TextProgressMeter()"),
}
FLOATS = ("float64", "float32")


def check_kinds(**options: Any) -> None:
    """Check that options that are not None are diffrax's objects, not classes or numbers."""
    for name, entry in options.items():
        kind, example = KINDS[name]
        if entry is not None:
            require_type(entry, kind, name, f"give one of diffrax, such as {example}")
    if isinstance(options["adjoint"], diffrax.BacksolveAdjoint):
        raise ValueError(
            "adjoint is BacksolveAdjoint, which leaves the loops; use diffrax.RecursiveCheckpointAdjoint()"
        )


def check_steps(
    solver: diffrax.AbstractSolver,
    controller: diffrax.AbstractStepSizeController,
    dt0: Number | None,
    max_steps: int | None,
    t0: Float[Array, ""],
    t1: Float[Array, ""],
) -> Scalar | None:
    """Check that a solver and a step control fit each other and the run; return dt0 as an array, or None."""
    if solver.term_structure is not diffrax.AbstractTerm:
        kind = type(solver).__name__
        raise ValueError(f"solver is {kind}, for equations of several terms; give another, such as diffrax.Dopri8()")
    if max_steps is not None:
        whole_number(max_steps, "max_steps")
    inside = MechanismControl(controller)
    if dt0 is None and isinstance(inside.innermost, diffrax.ConstantStepSize):
        raise ValueError("stepsize_controller is ConstantStepSize, and dt0 is None; give the steps by dt0=... [s]")
    if isinstance(inside.innermost, diffrax.StepTo):
        if dt0 is not None:
            raise ValueError(f"dt0 is {dt0!r}, and stepsize_controller is StepTo, which has the steps; leave out one")
        _check_times(inside.innermost.ts, "stepsize_controller: ts [s]", t0, t1)
    if inside.is_adaptive and not estimates_errors(solver):
        raise ValueError(
            f"solver is {type(solver).__name__}, which estimates no error for steps that adapt; use "
            "stepsize_controller=diffrax.ConstantStepSize() and dt0=..., or another solver"
        )
    if dt0 is None:
        return None
    return positive(dt0, "dt0 [s]")


def check_accuracy(accuracy: Accuracy) -> None:
    """Check that this is a `linkax.Accuracy`."""
    presets = "give linkax.DRAFT, BALANCED, PRECISE or linkax.Accuracy(rtol=...)"
    require_type(accuracy, Accuracy, "accuracy", presets)


def estimates_errors(solver: diffrax.AbstractSolver) -> bool:
    """Whether a solver estimates the error of its steps."""
    tableau = getattr(solver, "tableau", None)
    return isinstance(solver, diffrax.AbstractAdaptiveSolver) and (tableau is None or bool(np.any(tableau.b_error)))


def traced_tolerances(controller: diffrax.AbstractStepSizeController) -> diffrax.AbstractStepSizeController:
    """Make arrays of tolerances given as Python floats, so that another value compiles nothing anew."""
    what = "stepsize_controller: a tolerance"

    def traced(tolerance):
        array = tolerance if isinstance(tolerance, jax.Array) else real(tolerance, what)
        right = lambda x: ((x >= 0.0) & (x <= 1.0)).all()
        return require(array, right, what, "it must be zero or more, and at most 1")

    return with_tolerances(traced, controller)


def check_saved_times(
    saveat: diffrax.SaveAt, t0: Float[Array, ""], t1: Float[Array, ""], max_steps: int | None
) -> None:
    """Check that saved times are in order from t0 to t1 [s], and that saved steps have a largest number."""
    if max_steps is None and (saveat.dense or any(sub.steps for sub in _subs(saveat))):
        raise ValueError("max_steps is None, and saveat keeps all steps; give their largest number, such as 4096")
    for ts in saved_times(saveat):
        _check_times(ts, "saveat: ts [s]", t0, t1)


def saves_times(saveat: diffrax.SaveAt | None) -> bool:
    """Whether states are saved at given times, and nothing else."""
    if jax.tree.structure(saveat) != _structure_of_times():
        return False
    (sub,) = _subs(saveat)
    return not (sub.t0 or sub.t1 or sub.steps)


@cache
def _structure_of_times():
    return jax.tree.structure(save_at(np.zeros(1)))


def save_at(ts: Any) -> diffrax.SaveAt:
    """Save states at times ts [s], an array of JAX or NumPy."""
    return diffrax.SaveAt(ts=ts)


def saved_times(saveat: diffrax.SaveAt) -> list[Any]:
    """All arrays of times in a `SaveAt`."""
    return [sub.ts for sub in _subs(saveat) if sub.ts is not None]


def _subs(saveat):
    is_sub = lambda node: isinstance(node, diffrax.SubSaveAt)
    return [*filter(is_sub, jax.tree.leaves(saveat.subs, is_leaf=is_sub))]


def _check_times(ts, what, t0, t1):
    ts = real(ts, what)
    if ts.ndim != 1:
        raise ValueError(f"{what} has shape {ts.shape}; give a list of times")
    if concrete(ts) is None:
        return  # a run tells
    first, last = (-np.inf if concrete(t0) is None else t0), (np.inf if concrete(t1) is None else t1)
    right = lambda ts: np.all(np.isfinite(ts)) and np.all(np.diff(ts) >= 0.0) and first <= ts[0] and ts[-1] <= last
    require(ts, right, what, f"give finite times in rising order, from t0 = {t0} s to t1 = {t1} s")


def floating(dtype: Any) -> np.dtype:
    """Check the floating-point type of a run."""
    try:
        is_array = isinstance(dtype, jax.Array | np.ndarray | np.generic)
        found = "none" if is_array else jnp.dtype(float if dtype is None else dtype).name
    except TypeError:
        found = "none"
    if found not in FLOATS:
        raise ValueError(f"dtype is {dtype!r}; give jnp.float64 (default) or jnp.float32")
    return jnp.dtype(found)


def with_tolerances(change: Callable[[Any], Any], tree: Tree) -> Tree:
    """Change all entries of a pytree that are named rtol or atol."""
    named = lambda path: path and getattr(path[-1], "name", None) in ("rtol", "atol")
    return jax.tree_util.tree_map_with_path(lambda path, leaf: change(leaf) if named(path) else leaf, tree)
