"""Our optimizer makes the steps of torch's, to the bit."""

from __future__ import annotations

import pytest
import torch

from mcaprl.offline.algorithms.optimizer import AdamW


@pytest.mark.parametrize("weight_decay", [0.0, 0.1])
def test_steps_are_those_of_torchs_class(weight_decay: float) -> None:
    torch.manual_seed(0)
    mine = [torch.randn(2, 48), torch.randn(1, 16)]
    theirs = [one.clone() for one in mine]
    ours = AdamW(mine, 1e-3, weight_decay)
    reference = torch.optim.AdamW(theirs, 1e-3, weight_decay=weight_decay, fused=True)
    for rate in (1e-3, 1e-3, 5e-4):
        for one, other in zip(mine, theirs, strict=True):
            one.grad = torch.randn_like(one)
            other.grad = one.grad.clone()
        ours.learning_rate = reference.param_groups[0]["lr"] = rate
        ours.step()
        reference.step()
        assert all(torch.equal(one, other) for one, other in zip(mine, theirs, strict=True))


def test_the_first_step_by_hand() -> None:
    # Moments of the first step, corrected, are g and g^2: the step is rate * g / (|g| + 1e-8).
    weights = torch.tensor([[1.0, -2.0]])
    optimizer = AdamW([weights], 0.1, 0.0)
    weights.grad = torch.tensor([[4.0, -0.5]])
    optimizer.step()
    torch.testing.assert_close(weights, torch.tensor([[0.9, -1.9]]))
