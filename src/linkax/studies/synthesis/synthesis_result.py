"""What `linkax.synthesis` finds."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from linkax.analysis.trace import Trace
from linkax.model.numbers import whole_number
from linkax.tables import Rows, Table, count, numbers, printed_as


class Candidate(NamedTuple):
    """A linkage as `linkax.synthesis` judges it.

    - `error`: arrays in any pytree, of which the sum of squares is minimised.
    - `conditions`: {name: array}, which must not be negative anywhere.
    - `trace`: the positions, all of which must be reached; None for a linkage that needs none.
    """

    error: Any
    conditions: Mapping[str, Any] = {}
    trace: Trace | None = None


def _table(found: "Synthesis") -> Table:
    title = f"Synthesis: {count(len(found.errors), 'linkage')} from {count(found.starts, 'start')}, "
    title += f"of which {found.possible} possible"
    leaves = [np.reshape(leaf, (len(found.errors), -1)) for leaf in jax.tree.leaves(found.params)]
    values = np.concatenate(leaves, axis=1)
    rows = [
        (str(i), numbers(error), *(numbers(found.conditions[name][i]) for name in found.conditions), numbers(values[i]))
        for i, error in enumerate(found.errors)
        if found.met[i]
    ]
    head = ("", "error", *(f"least {name}" for name in found.conditions), ", ".join(found.names))
    return Table(title, [Rows(head, rows, "linkages")])


@printed_as(_table)
class Synthesis(NamedTuple):
    """Linkages, the best first: those that meet all conditions by their errors, and then the others.

    - `params`: in the structure of those given, with an axis of the n linkages before theirs.
    - `errors`: sums of squares of the error, (n,). `conditions`: {name: the least of it}, (n,) each.
    - `met`: whether all conditions hold, (n,). `ended`: how each last search ended, see `linkax.Fit`.
    - `names`: of the numbers in `params`. `possible`: how many of the `starts` have a trace that reaches all positions.
    """

    params: Any
    errors: Float[np.ndarray, " n"]
    conditions: dict[str, Float[np.ndarray, " n"]]
    met: Bool[np.ndarray, " n"]
    ended: list[str]
    names: list[str]
    possible: int
    starts: int
    function: Callable[[Any], Candidate]

    def params_of(self, index: int) -> Any:
        """Parameters of one linkage, in the structure of those given.

        **Raises:** `ValueError` for an index beyond the linkages.
        """
        if whole_number(index, "index", least=0) >= len(self.errors):
            raise ValueError(f"index is {index}; {len(self.errors)} linkages were found")
        return jax.tree.map(lambda leaf: leaf[index], self.params)

    def candidate(self, index: int) -> Candidate:
        """One linkage with its trace, such as to plot it.

        **Raises:** `ValueError` for an index beyond the linkages.
        """
        return _evaluated(self.function, self.params_of(index))


@eqx.filter_jit
def _evaluated(function, params):
    return function(params)
