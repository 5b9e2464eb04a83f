"""Warnings that point to the line of the user, however far below it they arise."""

import sys
import threading
import warnings
from collections.abc import Iterator
from types import FrameType

from scalarjit.libraries import LIBRARIES


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the innermost line that is in no library; in a thread of linkax, at the one where the main thread waits.

    The outermost line stands for it where there is none.
    """
    waiting = sys._current_frames()[threading.main_thread().ident or 0]
    frames = [*_outward(sys._getframe(1)), *_outward(waiting)]
    frame = next((frame for frame in frames if not _in_library(frame)), frames[-1])
    registry = frame.f_globals.setdefault("__warningregistry__", {})
    module = frame.f_globals.get("__name__", "<string>")
    warnings.warn_explicit(message, category, frame.f_code.co_filename, frame.f_lineno, module, registry)


def _outward(frame: FrameType | None) -> Iterator[FrameType]:
    while frame is not None:
        yield frame
        frame = frame.f_back


def _in_library(frame) -> bool:
    # Code that is made at run time has the globals of a library, and no file.
    return (frame.f_globals.get("__file__") or "").startswith(LIBRARIES)
