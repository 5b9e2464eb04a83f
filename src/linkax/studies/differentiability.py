"""Whether a motion has derivatives: none by parameters that contradict redundant loops, or undo a singular position."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from linkax.analysis.mobility import row_names
from linkax.equations.configuration import configure
from linkax.equations.loops import immobile_residual, jacobian, residual
from linkax.equations.system import system_of
from linkax.model.numbers import require_type
from linkax.simulation.integrate.results import ENDED_WELL, result_name
from linkax.simulation.read.passages import singular_states
from linkax.simulation.read.solution import Solution
from linkax.studies.free_parameters import FreeParameters

DEPENDENT = 1e-4  # singular values of J in radians and lengths of the mechanism: of rows that depend on others
OPENS = 1e-3  # the part of a change of the loops that no motion takes back
SEEN = 3.0  # times the smallest distance of any stage, above which saved times do not show it
ROUNDING = 1e-9  # of rows, by relative changes of parameters


class Differentiability(NamedTuple):
    """By which parameters a motion has derivatives.

    - `names`: of the p free numbers in `params`; those of a `PhysicalInertia` have the same one.
    - `reasons`: of each that it has no derivative by, why.
    - `directions`: changes of all parameters together that keep what is there, as orthonormal columns (p, k), each
      parameter in units of its own value.
    """

    names: list[str]
    reasons: dict[str, str]
    directions: np.ndarray

    @property
    def ok(self) -> bool:
        """Whether there are derivatives by all parameters."""
        return not self.reasons

    def __str__(self):
        return "\n".join(f"{name}: {self.reasons.get(name, 'differentiable')}" for name in self.names)


def differentiability(function: Callable, params: Any) -> Differentiability:
    """Find by which parameters the motion has derivatives.

    Where constraints are redundant, always or in a singular configuration alone, a change of a length may contradict
    them: the mechanism locks, or its branches part and it turns back where it went through. `jax.grad` by such a
    parameter is the derivative of the motion that comes nearest, which is not that of the mechanism. To first order
    this is so where uᵀ ∂c/∂θ ≠ 0 for a u with uᵀ J = 0; that is looked for at all saved states and passages.

    **Arguments:**

    - `function`: params -> a `Solution` of one motion that went well, such as what `simulate` returns.
    - `params`: pytree of numbers and arrays, as for `linkax.fit`.

    **Raises:** `ValueError` for a function that returns no `Solution`, a batch, or one of a run that failed, and for
    saved times too far apart to show singular configurations.
    """
    require_type(function, Callable, "function", "give a function that returns a linkax.Solution")
    free = FreeParameters.of(params)
    solution = function(free.params(free.start))
    if not isinstance(solution, Solution):
        raise ValueError(f"the function returns {type(solution).__name__}; it must return a linkax.Solution")
    if (name := result_name(solution.result)) not in ENDED_WELL:
        raise ValueError(f"the run ended as {name!r}: there is no motion to differentiate")
    reached = np.isfinite(np.asarray(solution.ts))
    times, states = singular_states(solution)
    seen = np.min(np.asarray(solution.singularity_distance())[reached], initial=1.0)
    closest, near = float(solution.closest), float(solution.accuracy.clearance)
    if np.sum(reached) < 2 or (len(times) == 0 and closest < near and seen > SEEN * closest):
        raise ValueError(
            f"the run came within {closest:.3g} of a singular configuration, its {np.sum(reached)} saved times within "
            f"{seen:.3g}: save more times, so that singular configurations are found between them"
        )
    ts = np.concatenate([np.asarray(solution.ts)[reached], times])
    qs = np.concatenate([np.asarray(solution.q)[reached], states])
    rows, changes = (np.asarray(part) for part in _linearised(function, free, solution.mechanism, ts, qs))
    joints = [joint for joint, _ in row_names(solution.mechanism.topology)]
    names = free.free_names
    reasons, opening = {}, [np.zeros((1, len(names)))]
    for index, (t, row, change) in enumerate(zip(ts, rows, changes, strict=True)):
        left, sizes, _ = np.linalg.svd(row)
        rank = int(np.sum(sizes > DEPENDENT * np.max(sizes, initial=1.0)))
        opens = left[:, rank:].T @ change
        opening.append(opens)
        most = OPENS * np.linalg.norm(change, axis=0) + ROUNDING
        for which in np.flatnonzero(np.linalg.norm(opens, axis=0) > most):
            joint = joints[int(np.argmax(np.abs(left[:, rank:] @ opens[:, which])))]
            why = _locks(joint) if index < np.sum(reached) else _unfolds(joint, t)
            reasons.setdefault(names[which], f"not differentiable: {why}")
    _, sizes, right = np.linalg.svd(np.concatenate(opening))
    directions = right[int(np.sum(sizes > OPENS * sizes[0] + ROUNDING)) :].T
    return Differentiability(names, reasons, directions)


def _locks(joint):
    return (
        f"alone it contradicts redundant constraints of the loop that joint {joint!r} closes, and the mechanism locks "
        "or cannot be assembled"
    )


def _unfolds(joint, t):
    return (
        f"alone it undoes the singular configuration at t = {t:.6g} s of the loop that joint {joint!r} closes, and the "
        "mechanism takes another branch or turns back"
    )


@eqx.filter_jit
def _linearised(function, free, mechanism, ts, qs):
    """J of all rows of a mechanism, and their changes with the parameters, at given coordinates."""
    dtype = qs.dtype

    def opened(z):
        system = system_of(function(free.params(z)).mechanism, dtype)

        def at(t, q):
            configuration = configure(system, t, q)
            return jnp.concatenate([residual(configuration), immobile_residual(configuration)])

        return jax.vmap(at)(ts, qs)

    system = system_of(mechanism, dtype)
    slopes = jax.vmap(lambda t, q: jacobian(configure(system, t, q)) * system.scales)(ts, qs)
    still = jnp.zeros((len(ts), system.topology.num_immobile_rows, slopes.shape[-1]), dtype)
    return jnp.concatenate([slopes, still], axis=1), jax.jacfwd(opened)(free.start)
