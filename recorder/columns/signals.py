"""Delay of SIGINT, SIGTERM and SIGHUP during writes that must not be interrupted."""

from __future__ import annotations

import inspect
import signal
import threading
from types import FrameType, TracebackType
from typing import Any, ClassVar

try:
    # These functions return plain numbers. Their wrappers in `signal` convert the numbers to enums,
    # which takes ten times as long.
    from _signal import getsignal  # type: ignore[import-not-found]
    from _signal import signal as set_handler
except ImportError:
    from signal import getsignal
    from signal import signal as set_handler

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
# Windows has no SIGHUP.
_HELD = tuple(getattr(signal, name) for name in _NAMES if hasattr(signal, name))


class HoldSignals:
    """Context manager that delays signals until its end, where they are handled as usual.

    A context has an effect only in the main thread, where Python runs all handlers. A nested
    context has no effect.
    """

    _is_held: ClassVar[bool] = False

    def __enter__(self) -> None:
        """Start to delay signals."""
        self._holds = not self._is_held and (threading.current_thread() is threading.main_thread())
        if not self._holds:
            return
        self._handlers: dict[int, Any] = {}
        self._waiting: list[int] = []
        try:
            HoldSignals._is_held = True
            for number in _HELD:
                handler = getsignal(number)
                # A handler that was not installed from Python (None) cannot be restored.
                if handler is not None:
                    self._handlers[number] = handler
                    set_handler(number, self._note)
        except BaseException:
            self._restore()
            raise

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Handle the delayed signals."""
        if not self._holds:
            return
        self._restore()
        for number in self._waiting:
            handler = self._handlers[number]
            if callable(handler):
                handler(number, inspect.currentframe())
            elif handler == signal.SIG_DFL:
                signal.raise_signal(number)

    def _note(self, number: int, frame: FrameType | None) -> None:
        # The frame is not stored: it would keep its local variables alive.
        self._waiting.append(number)

    def _restore(self) -> None:
        HoldSignals._is_held = False
        for number, handler in self._handlers.items():
            set_handler(number, handler)
