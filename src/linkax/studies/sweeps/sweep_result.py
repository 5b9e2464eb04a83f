"""The result of a sweep, and how its members ended."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Int

from linkax.simulation.integrate.results import ENDED_WELL, KNOWN_RESULTS, REMARKS, RESULTS
from linkax.tables import Rows, Table, count, numbers, printed_as
from linkax.xla.enumerations import code

REASONS = (*KNOWN_RESULTS, "failed", "not_finite_output", "not_run")
FINE = [REASONS.index(name) for name in ENDED_WELL]
NOT_FINITE_OUTPUT, NOT_RUN = (REASONS.index(name) for name in ("not_finite_output", "not_run"))
EXPLANATIONS = {
    "failed": "failed",
    "not_finite_output": "The function returned numbers that are not finite, and no solution or result that tells why.",
    "not_run": "This member has not been run.",
}


def _table(sweep: "Sweep") -> Table:
    title = f"Sweep of {count(len(sweep.reasons), 'member')}: {int(np.sum(sweep.ok))} ended well"
    facts = [("ended", ", ".join(f"{times} {name}" for name, times in sweep.count().items()))]
    for what, members in (("failed", sweep.failed), ("with a remark", sweep.remarked)):
        for member, told in list(members.items())[:1]:
            facts.append((what, f"{len(members)}, the first of them {member}: {told}"))
    facts.append(("time of a member", numbers(sweep.seconds_per_member, "s")))
    leaves = jax.tree_util.tree_leaves_with_path(sweep.output)
    rows = [(f"output{jax.tree_util.keystr(path)}", _shape(leaf), numbers(leaf, axes=0)) for path, leaf in leaves]
    return Table(title, [Rows((), facts), Rows(("", "shape", "range"), rows, "outputs")])


def _shape(leaf):
    return " × ".join(map(str, np.shape(leaf)))


@printed_as(_table)
class Sweep(NamedTuple):
    """Outputs of a function for the n members of a batch, and how each member ended.

    - `output`: as the function returns it, arrays with a leading axis of members; where a member failed, what it had
      computed until then.
    - `reasons`: how each member ended, as an index into `linkax.studies.sweeps.sweep_result.REASONS`, (n,).
    - `seconds_per_member`: wall time without compilation, but for that of an executor's later workers [s]; NaN where a
      store held all members already.
    - `remarks`: a `linkax.REMARKS` of each member, (n,): what a single run would warn of. Known where the function
      returns a `Solution` or `solution.remark()`.
    """

    output: Any
    reasons: Int[np.ndarray, " n"]
    seconds_per_member: float
    remarks: REMARKS

    @property
    def ok(self) -> Bool[np.ndarray, " n"]:
        """Whether each member ended well, (n,)."""
        return np.isin(self.reasons, FINE)

    @property
    def failed(self) -> dict[int, str]:
        """{member: why it failed}."""
        return {member: self.reason(member) for member in np.flatnonzero(~self.ok).tolist()}

    def reason(self, member: int) -> str:
        """How a member ended, in words."""
        name = REASONS[self.reasons[member]]
        return EXPLANATIONS[name] if name in EXPLANATIONS else RESULTS[getattr(RESULTS, name)]

    @property
    def remarked(self) -> dict[int, str]:
        """{member: its remark, in words}, of members that have one."""
        each = lambda member: REMARKS[jax.tree.map(lambda values: np.asarray(values[member]), self.remarks)]
        return {member: each(member) for member in np.flatnonzero(code(self.remarks)).tolist()}

    def count(self) -> dict[str, int]:  # type: ignore[override]  # hides that of tuples
        """{name of a result: number of members that ended so}."""
        return {name: int(np.sum(self.reasons == index)) for index, name in enumerate(REASONS) if index in self.reasons}
