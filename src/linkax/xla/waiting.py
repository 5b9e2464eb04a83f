"""One line on stderr that tells who waits what is done; it vanishes, and where nobody watches nothing is written.

JAX tells beforehand neither that it will compile nor how long that takes, so the line counts seconds, and comes where a
program is known to be a first one.
"""

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from scalarjit.garbage import collected_later

WORTH_TELLING = 2.0  # a shorter wait tells nothing [s]
WIDTH = 78

_telling = threading.Lock()
_in_notebook: list[Any] = []  # IPython's handle of the line that a notebook shows


def is_watched() -> bool:
    """Whether a terminal or a notebook shows at once what is written to stderr."""
    return sys.stderr is not None and (sys.stderr.isatty() or _is_notebook())


def _is_notebook():
    return type(sys.stderr).__module__.startswith("ipykernel")


def tell(text: str) -> None:
    """Show a text in place of the one before."""
    if _is_notebook():
        from IPython.display import display  # pyright: ignore[reportMissingImports]  (notebooks bring it)

        if not _in_notebook:
            _in_notebook.append(display({"text/plain": ""}, raw=True, display_id=True))
        _in_notebook[0].update({"text/plain": text}, raw=True)
        return
    print(f"\r{text[:WIDTH]:<{WIDTH}}", end="", file=sys.stderr, flush=True)


def end_line() -> None:
    """Remove the text that is shown."""
    tell("")
    if _is_notebook():
        _in_notebook.clear()
        return
    print("\r", end="", file=sys.stderr, flush=True)


@contextmanager
def compiling(is_first: bool = True) -> Iterator[None]:
    """Tell that programs are traced and compiled meanwhile, once that has lasted two seconds."""
    if not is_first:
        yield
        return
    with collected_later(), _telling_of_it():
        yield


@contextmanager
def _telling_of_it():
    if not (is_watched() and _telling.acquire(blocking=False)):  # one line for what is within another
        yield
        return
    done = threading.Event()
    teller = threading.Thread(target=_count, args=(done, time.monotonic()), daemon=True)
    teller.start()
    try:
        yield
    finally:
        done.set()
        teller.join()
        _telling.release()


def _count(done, began):
    told = False
    while not done.wait(0.5 if told else WORTH_TELLING):
        told = True
        tell(f"linkax: compiling, {time.monotonic() - began:.0f} s so far; later runs reuse it")
    if told:
        end_line()


class Progress:
    """How far a long computation has come, as a line; where it has to be told and nobody watches, now and then one.

    **Arguments:** `total`: number of `unit`s, such as members or steps; `shown`: None for where somebody watches.
    """

    def __init__(self, total: int, unit: str, shown: bool | None) -> None:
        self.total, self.unit = total, unit
        self.shown = is_watched() if shown is None else shown
        self.began, self.last = time.monotonic(), -float("inf")

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_error: object) -> None:
        if self.shown and is_watched():
            end_line()

    def tell(self, what: str, count: int, more: str = "") -> None:
        """Tell what is done, and how many are, in no more than a few lines a second, or a minute where it is a pipe."""
        now, pause = time.monotonic(), 0.1 if is_watched() else 10.0
        if not self.shown or (now - self.last < pause and count < self.total):
            return
        self.last = now
        text = f"linkax: {what}, {count} of {self.total} {self.unit}s, {now - self.began:.0f} s{more}"
        if is_watched():
            tell(text)
        else:
            print(text, file=sys.stderr, flush=True)
