"""The command `linkax`, which hears Ctrl-C from its first moment, before linkax is imported.

Python tells its main thread of a signal once the call that this is in returns, and XLA compiles and runs for minutes in
one call. The KeyboardInterrupt that it raises then, anywhere, a callback may swallow, or it leaves XLA half way. So
another thread hears the signal, and ends the process while the main thread rests.
"""

import _thread  # `threading` and `socket` would take their time
import os
import signal
import time
from collections.abc import Callable

INTERRUPTED = 128 + signal.SIGINT  # the exit code

_ended = {}  # {"by": "interrupt" or "itself"}, whichever was first
_keeping = {"last": lambda: ""}


def main() -> int:
    """Run the command line; see `linkax.cli.main`. Ctrl-C ends it with one line and code 130, twice at once."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not one that a shell keeps from background jobs
        _listen()
    try:
        from linkax.cli import main as run

        return run()
    finally:
        if not _ends_by("itself"):
            _rest()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # while Python ends


def at_interrupt(keep: Callable[[], str]):
    """Have `keep` called at Ctrl-C, in another thread: it writes what has been computed, and says so in a few words."""
    _keeping["last"] = keep


def _listen():
    ears, mouth = os.pipe()
    if os.name == "posix":
        os.set_blocking(mouth, False)
    signal.set_wakeup_fd(mouth)
    _thread.start_new_thread(_hear, (ears,))
    signal.signal(signal.SIGINT, lambda *_: _ends_by("interrupt") and _rest())


def _ends_by(what) -> bool:
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
