"""Worker processes that end when their parent ends, even if it is killed."""

from __future__ import annotations

import multiprocessing
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any, Literal, TypeVar

from mcaprl._interrupt import is_postponed, send_to_main_thread
from mcaprl.errors import McaprlError

if sys.platform != "win32":
    from multiprocessing import resource_tracker

T = TypeVar("T")
_Kind = Literal["message", "done", "interrupted", "error"]
_STOPS = [
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
]
# Signal that ends a worker: SIGTERM, because background processes ignore SIGINT. Windows has no
# SIGTERM, so SIGINT is used there.
_END = signal.SIGINT if sys.platform == "win32" else signal.SIGTERM


class WorkerEndedError(Exception):
    """A worker ended before its task was done.

    Attributes:
        index: Index of the worker's request.
        cause: Cause of the end, such as `was killed by SIGKILL`.
    """

    def __init__(self, index: int, exit_code: int) -> None:
        """Describe the exit code of a process."""
        self.index, self.cause = index, f"ended with exit code {exit_code}"
        if exit_code < 0:
            with suppress(ValueError):
                self.cause = f"was killed by {signal.Signals(-exit_code).name}"
        super().__init__(f"worker {index} {self.cause}")


def run_workers(
    task: Callable[[T, Callable[[Any], None]], None],
    requests: Sequence[T],
    on_message: Callable[[int, Any], None],
) -> None:
    """Run a task in one process for each request, until all are done.

    If a worker fails, or this process is interrupted, all other tasks receive a KeyboardInterrupt,
    and this function waits until they end. If this process is killed, all tasks receive a
    KeyboardInterrupt, too.
    """
    context = multiprocessing.get_context("spawn")
    # Only this process has `held`, the write end of the pipe. Therefore, the pipe closes when this
    # process ends.
    ours, held = context.Pipe(duplex=False)
    processes = []
    open_pipes: dict[Connection, int] = {}
    try:
        with _signals_blocked():
            for index, request in enumerate(requests):
                messages, sender = context.Pipe(duplex=False)
                process = context.Process(target=_work, args=(task, request, ours, sender))
                process.start()
                sender.close()
                processes.append(process)
                open_pipes[messages] = index
        while open_pipes:
            ready = wait(list(open_pipes))
            for messages, index in [item for item in open_pipes.items() if item[0] in ready]:
                try:
                    kind, content = messages.recv()
                except (EOFError, ConnectionResetError):
                    del open_pipes[messages]
                    processes[index].join()
                    raise WorkerEndedError(index, processes[index].exitcode or 0) from None
                if kind == "message":
                    on_message(index, content)
                elif kind == "error":
                    raise content
                elif kind == "interrupted":
                    raise KeyboardInterrupt
                else:
                    del open_pipes[messages]
    finally:
        held.close()
        for messages in open_pipes:
            # Drain the pipe, because a worker that is blocked on a full pipe would not end.
            with suppress(EOFError, OSError):
                while True:
                    messages.recv_bytes()
        for process in processes:
            process.join()


def _work(
    task: Callable[[T, Callable[[Any], None]], None], request: T, parent: Connection, to: Connection
) -> None:
    """Run a task; send its messages, and then its outcome."""
    outcome: tuple[_Kind, Any]
    try:
        for number in _STOPS:
            if signal.getsignal(number) is not signal.SIG_IGN or number == _END:
                signal.signal(number, _interrupt_once)
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
        if sys.platform != "win32":
            signal.pthread_sigmask(signal.SIG_UNBLOCK, _STOPS)
        task(request, partial(_send, to))
        outcome = "done", None
    except KeyboardInterrupt:
        outcome = "interrupted", None
    except Exception as error:
        if not isinstance(error, McaprlError | OSError):
            error.add_note(f"in a worker process:\n{traceback.format_exc()}")
        outcome = "error", error
    _ignore_stops()
    with suppress(BrokenPipeError):
        to.send(outcome)


def _send(to: Connection, content: Any) -> None:
    try:
        to.send(("message", content))
    except BrokenPipeError:
        # The parent was killed.
        _interrupt_once()


def _end_with(parent: Connection) -> None:
    """Interrupt the main thread when the parent exits or closes the pipe."""
    with suppress(EOFError, OSError):
        parent.recv()
    send_to_main_thread(_END)


def _interrupt_once(number: int = _END, frame: FrameType | None = None) -> None:
    if is_postponed(number, frame):
        return
    # The terminal and the parent both send a signal. The second must not interrupt the clean-up.
    _ignore_stops()
    raise KeyboardInterrupt


def _ignore_stops() -> None:
    # Do not use SIG_IGN, because Python then prints an error for a signal that has already arrived.
    for number in _STOPS:
        signal.signal(number, _ignore)


def _ignore(*_: Any) -> None:
    pass


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """Block signals in this thread and in new processes. A process unblocks them when ready."""
    if sys.platform == "win32":
        yield
        return
    # Start the resource tracker first: its start unblocks the signals.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _STOPS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
