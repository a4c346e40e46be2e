"""Double DQN on SB3's DQN: the target network evaluates the online network's best action.

    https://arxiv.org/abs/1509.06461    target r + gamma Q'(s', argmax_a Q(s', a))

With `n_steps` n, the target is the sum of n discounted rewards, plus gamma^n times the value Q' n
steps later. SB3's replay buffer returns the sum and gamma^n. If the episode ends earlier, n is
smaller.

With `alpha` above 0, CQL's penalty is added to the loss, as in `offline/algorithms/cql.py`:

    https://arxiv.org/abs/2006.04779    alpha (logsumexp_a Q(s, a) - Q(s, a_buffer))
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.noise import ActionNoise
from torch.nn import functional


class WarmDQN(DQN):
    """SB3's DQN with an option for pretrained weights.

    Attributes:
        skips_random_steps: Whether the steps before learning follow the policy instead of taking
            random actions. Learning does not start earlier, because learning from too few
            transitions would destroy the pretrained weights (https://arxiv.org/abs/2412.07762).
    """

    skips_random_steps = False

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        starts = 0 if self.skips_random_steps else learning_starts
        return super()._sample_action(starts, action_noise, n_envs)


class DoubleDQN(WarmDQN):
    """SB3's DQN with the Double DQN target and an optional penalty of CQL.

    `DQN.load` also loads the `.zip` files of this class.

    Attributes:
        alpha: Weight of CQL's penalty on actions that are not in the replay buffer; 0 disables it.
    """

    alpha = 0.0

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Run gradient steps on batches from the replay buffer."""
        assert self.replay_buffer is not None
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        losses, mean_values = [], []
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            discounts = self.gamma if batch.discounts is None else batch.discounts
            with torch.no_grad():
                best = self.q_net(batch.next_observations).argmax(1, keepdim=True)
                values_t = self.q_net_target(batch.next_observations).gather(1, best)
                targets = batch.rewards + (1 - batch.dones) * discounts * values_t
            values_of_all = self.q_net(batch.observations)
            values = values_of_all.gather(1, batch.actions.long())
            loss = functional.smooth_l1_loss(values, targets)
            if self.alpha:
                actions = batch.actions[:, 0].long()
                loss = loss + self.alpha * functional.cross_entropy(values_of_all, actions)
            self.policy.optimizer.zero_grad()
            torch.autograd.backward(loss)
            torch.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
            self.policy.optimizer.step()
            losses.append(loss.detach().item())
            mean_values.append(values.detach().mean().item())
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", np.mean(losses))
        self.logger.record("train/mean_q", np.mean(mean_values))
