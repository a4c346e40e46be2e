"""Shared fixture of the tests that read messages."""

from __future__ import annotations

import pytest

from mcaprl.recorder.columns import records
from tests.conftest import need


@pytest.fixture(params=["compiled", "numpy"])
def each_copy(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a test twice: with the compiled copy of messages, and with that of NumPy."""
    if request.param == "numpy":
        monkeypatch.setattr(records, "copy_fields", None)
    else:
        need(records.copy_fields is not None, "the C extension was not built")
