"""The steps of a run that its derivatives need: those of the last tries, and from where others are computed again.

A run may take tens of thousands of steps, and takes a few dozen. So rows for some hundred tries are written again and
again, and the state of the integration is kept each time they are full.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from linkax.xla.arrays import Array

ROWS = 256  # tries that are kept at least: most runs take fewer, of which none is made again


class LoopState(NamedTuple):
    """From where an integration goes on: the next step, from (t0, y) to t1, and states of step control and solver.

    Of a solver that keeps the rates of its last stage, these are not those at y, which was corrected since.
    """

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    y: Float[Array, " n"]
    control: Any
    solver: Any


class Size(NamedTuple):
    """How many tries are a group, and how many groups there may be."""

    rows: int
    groups: int

    @staticmethod
    def of(max_steps: int) -> "Size":
        """Take about as many rows as groups, but no few rows."""
        rows = min(max_steps, max(ROWS, math.isqrt(max_steps)))
        return Size(rows, -(-max_steps // rows))


class StepRecord(NamedTuple):
    """The accepted steps among the last group of tries, and from where each group of tries begins.

    - `ts`, `ys`: ends of these steps, (rows + 1, ...), the start of the group first; `count`: how many steps.
    - `tries`: of the run, accepted or not. `starts`: a `LoopState` with a row for each group.
    """

    ts: Float[Array, " ends"]
    ys: Float[Array, "ends n"]
    count: Int[Array, ""]
    tries: Int[Array, ""]
    starts: LoopState

    @staticmethod
    def empty(start: LoopState, size: Size) -> "StepRecord":
        """Make the record of a run that goes on from a start, before the first try."""
        rows, groups = size
        several = lambda number, part: jnp.broadcast_to(part, (number, *jnp.shape(part)))
        starts = jax.tree.map(lambda part: several(groups, part), start)
        none = jnp.zeros((), int)
        return StepRecord(several(rows + 1, start.t0), several(rows + 1, start.y), none, none, starts)

    @property
    def rows(self) -> int:
        """How many tries are a group."""
        return len(self.ts) - 1

    @property
    def last(self) -> Int[Array, ""]:
        """The group of the last tries."""
        return jnp.maximum(self.tries - 1, 0) // self.rows

    def start(self, group: Int[Array, ""]) -> LoopState:
        """From where a group of tries begins."""
        return jax.tree.map(lambda rows: rows[group], self.starts)

    def after(
        self, before: LoopState, is_accepted: Bool[Array, ""], t: Float[Array, ""], y: Float[Array, " n"]
    ) -> "StepRecord":
        """The record after one more try, from the state `before` to (t, y)."""
        begins = self.tries % self.rows == 0
        group = self.tries // self.rows
        count = jnp.where(begins, 0, self.count)
        written = lambda rows, row, value, where: rows.at[row].set(
            jnp.where(where, value, rows[row]).astype(rows.dtype)
        )
        starts = jax.tree.map(lambda rows, part: written(rows, group, part, begins), self.starts, before)
        ts = written(self.ts, 0, before.t0, begins)
        ys = written(self.ys, 0, before.y, begins)
        ts = written(ts, count + 1, t, is_accepted)
        ys = written(ys, count + 1, y, is_accepted)
        return StepRecord(ts, ys, count + is_accepted, self.tries + 1, starts)
