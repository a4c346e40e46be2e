"""Logs of recorders that a program does not close."""

from __future__ import annotations

import atexit
import os
import weakref
from abc import ABC, abstractmethod

_OPEN: weakref.WeakSet[FinishesAtExit] = weakref.WeakSet()


class FinishesAtExit(ABC):
    """Base class of recorders, whose log is finished when they are deleted or Python exits.

    A log that is not finished has no summary, so viewers cannot open it.
    """

    _process: int | None = None

    def _watch(self) -> None:
        """Finish the log at exit; call this at the end of the constructor."""
        self._process = os.getpid()
        _OPEN.add(self)

    @abstractmethod
    def _finish(self) -> None:
        """Finish the log, if this has not been done."""

    def _finish_own(self) -> None:
        """Finish the log, unless it belongs to the process from which this one was forked."""
        if self._process == os.getpid():
            self._finish()

    def __del__(self) -> None:
        """Finish the log, and call the environment's own `__del__`, if it has one."""
        if self._process is None:
            # The constructor raised an error, so the environment still belongs to the caller.
            return
        try:
            self._finish_own()
        finally:
            getattr(super(), "__del__", _nothing)()


def _nothing() -> None:
    """Do nothing."""


@atexit.register
def _finish_all() -> None:
    for recorder in list(_OPEN):
        recorder._finish_own()
