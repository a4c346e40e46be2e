"""Actions relative to the observation of the step in which they are predicted.

A joint that moves from where it is needs the difference of a command and the measured position, not
the command. In a chunk, the action of each step is relative to the observation of the chunk's first
step, so that the range of the k-th action grows with k. The ranges are those of the chunks of the
episodes that are learned from: those of single steps would be too small, and those of all episodes
would contain the ones that are held out.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from mcaprl.actions import BoxActions
from mcaprl.errors import SpaceError
from mcaprl.offline.batches.observations import ObservationEncoder

_SPARE = 1e-6


class RelativeActions(nn.Module):
    """Conversion of chunks (R, H, n) of scaled actions to relative numbers, mostly in [-1, 1].

    With an action a of the k-th step and a reference r, which is the observed value, both scaled
    as `BoxActions` does, the number is 2 (a - r - low_k) / (high_k - low_k) - 1. Absolute elements
    have r = 0, low = -1 and high = 1, so that they stay the same.
    """

    low: Tensor  # (H, n) smallest difference at each step of a chunk
    high: Tensor  # (H, n) largest difference at each step of a chunk
    _columns: Tensor
    _gain: Tensor
    _offset: Tensor

    def __init__(
        self,
        relation: tuple[int | None, ...],
        encoder: ObservationEncoder,
        box: BoxActions,
        low: Tensor,
        high: Tensor,
    ) -> None:
        """Prepare the conversion, for observations of an encoder."""
        super().__init__()
        width = encoder.width
        shapes = [tuple(part.shape or ()) for _, part in encoder.numbers]
        if len(relation) != box.size or not all(
            each is None or 0 <= each < width for each in relation
        ):
            raise SpaceError(
                f"relative actions need an element of the observation's {width} numbers for each"
                f" of {box.size} elements of the action, got {list(relation)}"
            )
        if len(shapes) != 1:
            raise SpaceError(
                "relative actions need one vector in the observation, or a vector beside images"
            )
        self.relation = relation  # Element of the observation for each element of an action
        is_relative = np.array([each is not None for each in relation])
        columns = np.array([each or 0 for each in relation])
        half = (box.high - box.low) / 2
        scale, shift = encoder.scale[columns], encoder.shift[columns]
        found = {
            "low": low.double(),
            "high": high.double(),
            "_columns": torch.from_numpy(columns),
            "_gain": torch.from_numpy(np.where(is_relative, scale / half, 0.0)),
            "_offset": torch.from_numpy(np.where(is_relative, (shift - box.low) / half - 1, 0.0)),
        }
        for name, tensor in found.items():
            self.register_buffer(name, tensor, persistent=False)
        self._width = width

    @classmethod
    def fitted(
        cls,
        relation: tuple[int | None, ...],
        encoder: ObservationEncoder,
        box: BoxActions,
        actions: Tensor,
        vectors: Tensor,
        ends: Tensor,
        rows: Tensor,
        length: int,
    ) -> RelativeActions:
        """Return the conversion with the ranges of the chunks that start at rows (M,)."""
        # `ends` (N,) has the row after the last one of each row's episode.
        plain = torch.ones(length, box.size, dtype=torch.float64)
        found = cls(relation, encoder, box, -plain, plain.clone())
        references = found._references(vectors.index_select(0, rows))[:, 0]
        is_relative = found._gain != 0
        for step in range(length):
            exist = rows + step < ends.index_select(0, rows)
            if exist.any():
                difference = actions.index_select(0, rows[exist] + step) - references[exist]
                low, high = difference.amin(0), difference.amax(0)
                # A difference that never changes is the middle of a range that is not empty.
                spare = _SPARE * (low == high)
                found.low[step] = torch.where(is_relative, low - spare, found.low[step])
                found.high[step] = torch.where(is_relative, high + spare, found.high[step])
        return found

    def numbers(self, actions: Tensor, vectors: Tensor) -> Tensor:
        """Return scaled actions (R, H, n) as relative numbers, given the encoded observations."""
        difference = actions - self._references(vectors)
        numbers = 2 * (difference - self.low) / (self.high - self.low) - 1
        return numbers.to(actions.dtype)

    def actions(self, numbers: Tensor, vectors: Tensor) -> Tensor:
        """Return relative numbers (R, H, n) as scaled actions, float64."""
        difference = self.low + (numbers + 1) / 2 * (self.high - self.low)
        return difference + self._references(vectors)

    def _references(self, vectors: Tensor) -> Tensor:
        """Return the scaled references (R, 1, n); of a frame stack, those of its newest frame."""
        newest = vectors[:, vectors.shape[1] - self._width :].double()
        return (newest.index_select(1, self._columns) * self._gain + self._offset).unsqueeze(1)
