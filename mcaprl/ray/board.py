"""Actor that passes messages of a training on a Ray cluster to the calling process.

Its process does not import torch, because this module does not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mcaprl.progress import TrainingProgress

if TYPE_CHECKING:
    from mcaprl.offline.training.metrics import OfflineSummary


class Board:
    """Actor that stores messages of the workers until the calling process reads them."""

    def __init__(self) -> None:
        """Create a board without messages."""
        self._news: list[TrainingProgress | str] = []
        self._summaries: list[OfflineSummary] | None = None
        self._error: Exception | None = None

    def report(self, news: TrainingProgress | str) -> bool:
        """Add metrics or a warning. Return False if the training must end."""
        self._news.append(news)
        return self._error is None

    def take(self) -> list[TrainingProgress | str]:
        """Return the metrics and warnings that were added since the last call."""
        news, self._news = self._news, []
        return news

    def fail(self, error: Exception) -> None:
        """Store the error that ends the training."""
        self._error = self._error or error

    def finish(self, summaries: list[OfflineSummary]) -> None:
        """Store the result."""
        self._summaries = summaries

    def outcome(self) -> tuple[list[OfflineSummary] | None, Exception | None]:
        """Return the result and the error; None for each that does not exist yet."""
        return self._summaries, self._error
