"""ReBRAC: TD3+BC with two weights of cloning, and layer normalization in the critics.

    https://arxiv.org/abs/2305.09836
        Q_e(s,a)  regression to r + gamma (min_e Q'_e(s', a') - critic_weight |a' - a'_data|^2)
        pi        minimize actor_weight |pi(s) - a_data|^2 - Q(s, pi(s)) / mean |Q(s, pi(s))|

Here Q is the smaller one of the two critics, and a'_data is the logged action of the next state.
The last step of an episode has no next logged action; its penalty is 0.

Departures from the paper: batches of 256 instead of 1,024, three layers of 128 instead of 256, and
those of `td3_bc`. The weights depend on the data in the paper; here they have one default.
"""

from __future__ import annotations

from torch import Tensor

from mcaprl.offline.algorithms.config import ReBRACConfig
from mcaprl.offline.algorithms.td3 import TD3
from mcaprl.offline.batches.buffer import Batch


class ReBRAC(TD3):
    """TD3 with a penalty on unlike actions in the loss of the actor and in the targets."""

    name = "rebrac"
    shares_encoder = False
    config_type = ReBRACConfig
    config: ReBRACConfig

    def policy_losses(self, batch: Batch) -> dict[str, Tensor]:
        """Return the actor's loss: the weighted squared distance minus the relative value."""
        actions = self.act(batch.observations)
        q = self.models["q"](batch.observations.with_actions(actions), frozen=True).amin(0)
        cloning_loss = (actions - batch.actions).square().sum(1)
        policy_loss = self.config.actor_weight * cloning_loss - self.relative(q)
        return {"cloning_loss": cloning_loss, "policy_loss": policy_loss}

    def next_penalty(self, batch: Batch, next_actions: Tensor) -> Tensor | float:
        """Return the weighted squared distances (R,) of next actions from the logged ones."""
        buffer = self.buffer
        next_rows = buffer.next_rows.index_select(0, batch.rows)
        logged = buffer.actions.index_select(0, next_rows.clamp_min(0))
        distance = (next_actions - logged).square().sum(1)
        return self.config.critic_weight * distance * (next_rows >= 0)
