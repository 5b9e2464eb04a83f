"""Hear Ctrl-C from the first moment on.

Python delivers a signal to its main thread only once the current call returns, and XLA compiles and runs for minutes in
one call. The KeyboardInterrupt that Python raises then may be swallowed by a callback, or leave XLA half way. Here
another thread hears the signal, and ends the process while the main thread sleeps.
"""

import _thread  # `threading` and `socket` take long to import
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

INTERRUPTED = 128 + signal.SIGINT  # the exit code

_ended: dict[str, str] = {}  # {"by": "interrupt" or "itself"}, whichever was first
_keeping: dict[str, Callable[[], str]] = {"last": lambda: ""}


@contextmanager
def heard() -> Iterator[None]:
    """Meanwhile Ctrl-C ends the process, with one line and code 130, and a second one ends it at once."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not one that a shell keeps from background jobs
        _listen()
    try:
        yield
    finally:
        if not _ends_by("itself"):
            _rest()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # while Python ends


def at_interrupt(keep: Callable[[], str]) -> None:
    """Call `keep` at Ctrl-C, in another thread; it writes what has been computed, and returns where, in a few words."""
    _keeping["last"] = keep


def _listen():
    ears, mouth = os.pipe()
    if os.name == "posix":
        os.set_blocking(mouth, False)
    signal.set_wakeup_fd(mouth)
    _thread.start_new_thread(_hear, (ears,))
    signal.signal(signal.SIGINT, lambda *_: _ends_by("interrupt") and _rest())


def _ends_by(what) -> bool:
    """Whether `what` was first to end the process."""
    return _ended.setdefault("by", what) == what


def _rest():
    while True:
        time.sleep(60.0)


def _hear(ears):
    _await_interrupt(ears)
    if _ends_by("interrupt"):
        _thread.start_new_thread(_end, ())
        _await_interrupt(ears)
        os._exit(INTERRUPTED)


def _await_interrupt(ears):
    while os.read(ears, 1)[0] != signal.SIGINT:
        pass


def _end():
    try:
        kept = _keeping["last"]()
    except Exception as error:
        kept = f"what was computed cannot be kept: {error}"
    try:
        line = "linkax: interrupted" + (f"; {' '.join(kept.split())}" if kept else "")
        os.write(2, f"{os.linesep if os.isatty(2) else ''}{line}{os.linesep}".encode())
    finally:
        os._exit(INTERRUPTED)
