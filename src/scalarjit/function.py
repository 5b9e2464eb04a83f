"""What a function of LLVM is: its graph, its arguments and its results."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from scalarjit.graph import Buffer, Graph


@dataclass(eq=False)
class Result:
    """What a function returns in one place: an argument, constants, or an array that it writes to memory."""

    shape: tuple[int, ...]
    dtype: np.dtype
    known: np.ndarray | None = None
    argument: int | None = None

    @property
    def is_written(self) -> bool:
        return self.argument is None and not (self.known is not None and np.all(self.known < 0))


@dataclass(eq=False)
class Function:
    """A function of LLVM: its graph, and what its arguments and results are.

    - `again`: gives an equal one with its graph, which is let go of once code has been written of it: graphs take four
      times the memory of their text, and are asked for again by batches alone.
    """

    graph: Graph
    known: list[np.ndarray | None]  # constants of the arguments
    again: "Callable[[], Function]"
    arguments: list[Buffer | None] = field(default_factory=list)  # None where all is constant
    results: list[Result] = field(default_factory=list)
    buffers: list[Buffer] = field(default_factory=list)  # of the results that are written

    has_graph: bool = True

    def with_graph(self) -> "Function":
        return self if self.has_graph else self.again()

    def let_go_of_graph(self) -> None:
        self.graph = Graph()
        self.has_graph = False

    @property
    def passed(self) -> list[Buffer]:
        return [buffer for buffer in self.arguments if buffer is not None]
