"""Find by which parameters a motion has no derivative.

These are parameters whose change contradicts redundant constraints, or undoes a singular configuration.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from linkax.analysis.mobility import row_names
from linkax.equations.configuration import configure
from linkax.equations.loops import immobile_residual, jacobian, residual
from linkax.equations.system import system_of
from linkax.model.numbers import require_type
from linkax.simulation.integrate.results import ENDED_WELL, result_name
from linkax.simulation.read.passages import singular_states
from linkax.simulation.read.solution import Solution
from linkax.studies.parameters.free_parameters import FreeParameters
from scalarjit.code import ByValue

DEPENDENT = 1e-4  # singular value of J [rad, lengths of the mechanism] up to which a row depends on others
OPENS = 1e-3  # part of a change of the loops, relative to it, from which it counts as one that no motion closes
SEEN = 3.0  # smallest distance at saved times, relative to that at any stage, above which saved times miss it
ROUNDING = 1e-9  # error of the derivatives of rows by relative changes of parameters


class Differentiability(NamedTuple):
    """By which parameters a motion has derivatives.

    - `names`: of the p free numbers in `params`; those of a `PhysicalInertia` share one name.
    - `reasons`: {name of a number that the motion has no derivative by: why}.
    - `directions`: changes of all parameters together that keep redundant constraints and singular configurations, as
      orthonormal columns, (p, k), each parameter in units of its own value.
    """

    names: list[str]
    reasons: dict[str, str]
    directions: Float[np.ndarray, "p k"]

    @property
    def ok(self) -> bool:
        """Whether the motion has derivatives by all parameters."""
        return not self.reasons

    def __str__(self) -> str:
        return "\n".join(f"{name}: {self.reasons.get(name, 'differentiable')}" for name in self.names)


def differentiability(function: Callable[[Any], Solution], params: Any) -> Differentiability:
    """Find by which parameters a motion has derivatives.

    Where constraints are redundant, always or only in a singular configuration, a changed length can contradict them:
    the mechanism locks, or its branches part, and it turns back where it passed through. There `jax.grad` returns the
    derivative of the nearest motion that closes the loops, which is not that of the mechanism. To first order this
    happens to a parameter θ where uᵀ ∂c/∂θ ≠ 0 for some u with uᵀ J = 0, which is tested at all saved states and
    passages.

    **Arguments:**

    - `function`: params -> a `Solution` of one motion that ended well, such as that of `simulate`.
    - `params`: pytree of numbers and arrays, as for `linkax.fit`.

    **Returns:** a `Differentiability`.

    **Raises:** `ValueError` for a function that returns no `Solution`, a batch, or the solution of a run that failed,
    and for saved times too far apart to show singular configurations.
    """
    function = ByValue.each(require_type(function, Callable, "function", "give a function that returns a Solution"))
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
    """J of all rows in the scales, and ∂c/∂z of all rows, at coordinates `qs` and times `ts`."""
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
