"""TD3+BC: the actor maximizes the value of its actions, and stays close to the logged actions.

    https://arxiv.org/abs/2106.06860
        Q_e(s,a)  regression to r + gamma min_e Q'_e(s', a'), where a' = pi'(s') + clipped noise
        pi        minimize |pi(s) - a_data|^2 - alpha Q_1(s, pi(s)) / mean |Q_1(s, pi(s))|

Q' and pi' are target networks, averages of the learning networks. The actor and the target networks
are updated every `policy_interval` and `target_interval` updates of the critics
(https://arxiv.org/abs/1802.09477).

Departures from the paper: the target networks are averaged faster and the learning rate is larger
and decays, because logs of robots are small and are trained on for thousands of updates instead of
a million. The mean of |Q| is that of the batch before the update.
"""

from __future__ import annotations

from torch import Tensor

from mcaprl.offline.algorithms.config import TD3BCConfig
from mcaprl.offline.algorithms.td3 import TD3
from mcaprl.offline.batches.buffer import Batch


class TD3BC(TD3):
    """TD3 with behavior cloning."""

    name = "td3-bc"
    shares_encoder = False
    config_type = TD3BCConfig
    config: TD3BCConfig

    def policy_losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the actor's loss: the squared error minus alpha times the relative value."""
        actions = self.act(batch.observations)
        inputs = batch.observations.with_actions(actions)
        q = self.models["q"](inputs, frozen=True, members=1).squeeze(0)
        cloning_loss = (actions - batch.actions).square().mean(1)
        policy_loss = cloning_loss - self.config.alpha * self.relative(q)
        return {"cloning_loss": cloning_loss, "policy_loss": policy_loss}
