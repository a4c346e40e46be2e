"""Scores of Q-functions by their Bellman errors on a log: BVFT and SBV.

The squared difference r + gamma V(s') - Q(s, a) is not the squared Bellman error: if the next state
is random, it also contains the variance of the target, which differs between Q-functions. Both
methods replace the target with an estimate of its mean given (s, a).

BVFT    Xie and Jiang, https://arxiv.org/abs/2008.04990; choice of the resolution and policy
        selection: Zhang and Jiang, https://arxiv.org/abs/2110.14000
        Mean of the targets over the transitions on which two Q-functions are about constant. Each
        pair of candidates is compared, and the loss of a candidate is its largest error.
SBV     Zitovsky et al., https://arxiv.org/abs/2302.00141
        Regression of the targets on (s, a), whose error is measured on other episodes.

In both, a smaller score is better. `--algo auto` uses neither, so they are not in the package.

P is the number of candidates, N of transitions, D of numbers in an observation, A of actions.

Departures from the papers. BVFT: resolutions are multiples of the spread of the log's returns. The
resolution is used at which the sum of the best candidate's loss and of the resolution itself is the
smallest; both are terms of the bound on the error. SBV: the network has a fixed number of updates,
and it is trained on one half of the episodes and compared on the other, so that all transitions
count.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

Floats = NDArray[np.float64]
RESOLUTIONS: Final = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Widths of the bins of BVFT, as multiples of the spread of the returns."""
_HIDDEN, _BATCH, _RATE = 64, 256, 1e-3


def bvft(q: Floats, targets: Floats, spread: float) -> Floats:
    """Return the loss (P,) of each candidate in the tournament, at the chosen resolution.

    Args:
        q: (P, N) each candidate's value of the logged action.
        targets: (P, N) each candidate's target r + gamma V(s').
        spread: Standard deviation of the discounted returns of the log.
    """
    found = [(bvft_losses(q, targets, width), width) for width in spread * np.array(RESOLUTIONS)]
    return min(found, key=lambda each: each[0].min() + each[1])[0]


def bvft_losses(q: Floats, targets: Floats, width: float) -> Floats:
    """Return the loss (P,) of each candidate: its largest error against another candidate.

    Transitions are grouped by the bins of two candidates' values. The error of the first is the
    root mean square of its value minus the mean target of the group.

    Args:
        q: (P, N) values of the logged actions.
        targets: (P, N) targets.
        width: Width of the bins.
    """
    bins = [np.unique(np.floor(one / width), return_inverse=True)[1] for one in q]
    errors = np.zeros((len(q), len(q)))
    for first in range(len(q)):
        for second in range(first, len(q)):
            pairs = bins[first] * (bins[second].max() + 1) + bins[second]
            group = np.unique(pairs, return_inverse=True)[1]
            counts = np.bincount(group)
            for row, column in ((first, second), (second, first)):
                means = np.bincount(group, targets[row]) / counts
                errors[row, column] = np.sqrt(((q[row] - means[group]) ** 2).mean())
    largest: Floats = errors.max(1)
    return largest


def sbv(
    q: Floats,
    targets: Floats,
    observations: NDArray[np.float32],
    actions: NDArray[np.int64],
    half: NDArray[np.bool_],
    *,
    updates: int = 1_000,
    seed: int = 0,
) -> Floats:
    """Return the root mean square difference (P,) of each candidate's Q and its regressed target.

    Args:
        q: (P, N) values of the logged actions.
        targets: (P, N) targets.
        observations: (N, D) states.
        actions: (N,) actions, counted from 0.
        half: (N,) whether a transition belongs to the first half of the episodes.
        updates: Gradient steps of each of the two regressions.
        seed: Seed of the weights and batches.
    """
    squares = np.zeros_like(q)
    inputs = torch.from_numpy((observations - observations.mean(0)) / (observations.std(0) + 1e-6))
    for training in (half, ~half):
        fitted = _regress(inputs, actions, targets, training, updates, seed)
        squares[:, ~training] = ((q - fitted) ** 2)[:, ~training]
    return np.asarray(np.sqrt(squares.mean(1)))


def _regress(
    inputs: Tensor,
    actions: NDArray[np.int64],
    targets: Floats,
    training: NDArray[np.bool_],
    updates: int,
    seed: int,
) -> Floats:
    """Return targets (P, N) fitted to the rows of `training`, by one network for each candidate."""
    random = torch.Generator().manual_seed(seed)
    rows = torch.from_numpy(np.flatnonzero(training))
    mean = targets[:, training].mean(1, keepdims=True)
    scale = targets[:, training].std(1, keepdims=True) + 1e-9
    wanted = torch.from_numpy(((targets - mean) / scale).astype(np.float32))
    taken, count = torch.from_numpy(actions), len(targets)
    widths = (inputs.shape[1], _HIDDEN, _HIDDEN, int(actions.max()) + 1)
    layers = [
        (
            (torch.randn(count, i, o, generator=random) * (2 / i) ** 0.5).requires_grad_(),
            torch.zeros(count, 1, o, requires_grad=True),
        )
        for i, o in pairwise(widths)
    ]

    def predicted(at: Tensor) -> Tensor:
        values = inputs[at].expand(count, -1, -1)
        for number, (weight, bias) in enumerate(layers, 1):
            values = torch.baddbmm(bias, values, weight)
            values = values if number == len(layers) else functional.relu(values)
        return values[:, torch.arange(len(at)), taken[at]]

    optimizer = torch.optim.Adam([tensor for layer in layers for tensor in layer], _RATE)
    for step in range(updates):
        at = rows[torch.randint(len(rows), (_BATCH,), generator=random)]
        loss = (predicted(at) - wanted[:, at]).square().mean(1).sum()
        optimizer.zero_grad()
        torch.autograd.backward(loss)
        optimizer.param_groups[0]["lr"] = _RATE * (1 - step / updates)
        optimizer.step()
    with torch.no_grad():
        parts = [predicted(at) for at in torch.split(torch.arange(len(inputs)), 4_096)]
        fitted = torch.cat(parts, 1).double().numpy()
    values: Floats = fitted * scale + mean
    return values
