"""The result of experiment design: the experiment, and how sure parameters will be."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from linkax.tables import Rows, Table, count, known, numbers, printed_as


def _table(found: "Design") -> Table:
    failed = f", {count(found.failed, 'run')} failed" if found.failed else ""
    title = f"Design by criterion {found.criterion}: {found.ended} after {count(found.steps, 'step')}{failed}"
    flat = lambda tree: np.concatenate([np.ravel(known(leaf)) for leaf in jax.tree.leaves(tree)])
    errors, before = (np.sqrt(np.diagonal(cov)) for cov in (found.covariance, found.covariance_before))
    columns = zip(found.names, flat(found.params), before, errors, before / errors, strict=True)
    rows = [(name, *map(numbers, values)) for name, *values in columns]
    head = ("parameter", "value", "standard error before", "after", "ratio")
    bounds = [name for name in found.active if name not in found.limits]
    nearest = sorted(found.limits.items(), key=lambda item: -item[1])
    limits = [(name, numbers(value), "reached" * (name in found.active)) for name, value in nearest]
    limits += [(name, "", "reached") for name in bounds]
    return Table(
        title, [Rows(head, rows, "parameters"), *[Rows(("limit", "excess", ""), limits, "limits")] * bool(limits)]
    )


@printed_as(_table)
class Design(NamedTuple):
    """An experiment, how sure it makes parameters, and how the search for it ended.

    - `design`: found numbers, in the structure of the initial `design`, with plain numbers in place of `Positive` and
      `Bounded`. `params`: the parameters for which it was found, likewise.
    - `names`: of the p numbers in `params`, in the order of `covariance`.
    - `covariance`: of these numbers, fitted to a record of this experiment, (p, p); `covariance_before`: to one of the
      design where the search started.
    - `criterion`: which was small. `history`: {"criterion": relative standard error by it, at each step}.
    - `limits`: {name: what must not be positive}. `active`: names of limits that are reached, and of numbers of the
      design at a bound.
    - `steps`: number of steps. `failed`: number of designs that were tried and whose run failed.
    - `ended`: "converged", or "out of steps"; "at an edge", where the standard errors would fall further but the run
      fails; "no better step"; "limits not met", by no design that was tried.
    """

    design: Any
    params: Any
    names: list[str]
    covariance: np.ndarray
    covariance_before: np.ndarray
    criterion: str
    history: dict[str, np.ndarray]
    limits: dict[str, float]
    active: list[str]
    steps: int
    failed: int
    ended: str

    @property
    def standard_errors(self) -> Any:
        """Standard deviation of each number fitted to a record of this experiment, in the structure of `params`."""
        return self._errors(self.covariance)

    @property
    def standard_errors_before(self) -> Any:
        """The same with the design where the search started."""
        return self._errors(self.covariance_before)

    def _errors(self, covariance):
        _, unravel = ravel_pytree(self.params)
        return jax.tree.map(np.asarray, unravel(jnp.sqrt(jnp.diagonal(jnp.asarray(covariance)))))
