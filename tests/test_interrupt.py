"""Tests of Ctrl-C where an exception would be lost."""

from __future__ import annotations

import importlib
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mcaprl import _interrupt

MODULE = """
import signal
signal.raise_signal(signal.SIGTERM)
is_complete = True
"""


@pytest.fixture(autouse=True)
def _handler(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    before = signal.signal(signal.SIGTERM, _interrupt.raise_interrupt)
    monkeypatch.setattr(sys, "unraisablehook", _interrupt.repeat_lost_interrupt)
    yield
    signal.signal(signal.SIGTERM, before)


def test_a_signal_during_an_import_acts_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "interrupted_module.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("interrupted_module")
    with pytest.raises(KeyboardInterrupt):
        time.sleep(60)
    assert module.is_complete


def test_an_import_that_lasts_is_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "endless_module.py").write_text(f"{MODULE}\nimport time\ntime.sleep(60)\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(_interrupt, "_LONGEST_S", 0.1)
    with pytest.raises(KeyboardInterrupt):
        importlib.import_module("endless_module")


def test_a_signal_in_a_callback_of_llvmlite_acts_after_it() -> None:
    done: list[str] = []
    code = """
def callback():
    signal.raise_signal(signal.SIGTERM)
    done.append("whole")
"""
    names: dict[str, Any] = {
        "__name__": "llvmlite.binding.executionengine",
        "signal": signal,
        "done": done,
    }
    exec(code, names)
    names["callback"]()
    with pytest.raises(KeyboardInterrupt):
        time.sleep(60)
    assert done == ["whole"]


def test_a_signal_in_a_finalizer_is_not_lost() -> None:
    class Finalized:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    Finalized()
    with pytest.raises(KeyboardInterrupt):
        time.sleep(60)


def test_elsewhere_a_signal_acts_at_once() -> None:
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)


def test_windows_sends_signals_to_the_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.delattr(signal, "pthread_kill")
    with pytest.raises(KeyboardInterrupt):
        _interrupt.send_to_main_thread(signal.SIGTERM)


def test_other_lost_exceptions_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    class Finalized:
        def __del__(self) -> None:
            raise ValueError("lost")

    Finalized()
    assert "ValueError: lost" in capsys.readouterr().err
