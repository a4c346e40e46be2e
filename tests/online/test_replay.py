"""Tests of the replay buffer on a device."""

from __future__ import annotations

import numpy as np
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.device.replay import ReplayBuffer
from mcaprl.offline.algorithms.config import DoubleDQNConfig

AGENTS, ENVS, SLOTS, GAMMA = 2, 3, 6, 0.5
WIDTH = AGENTS * ENVS
CPU = torch.device("cpu")


def replay_of(n_steps: int) -> ReplayBuffer:
    """Return an empty buffer."""
    config = DoubleDQNConfig(n_steps=n_steps, gamma=GAMMA)
    box = spaces.Box(-np.inf, np.inf, (1,))
    return ReplayBuffer(box, spaces.Discrete(4), config, AGENTS, ENVS, SLOTS, CPU, seed=0)


@given(
    n_steps=st.integers(1, 4),
    steps=st.integers(1, 20),
    ends=st.lists(st.tuples(st.integers(0, 19), st.integers(0, WIDTH - 1), st.booleans())),
)
def test_a_batch_has_the_returns_of_the_recorded_steps(
    n_steps: int, steps: int, ends: list[tuple[int, int, bool]]
) -> None:
    # The observation of step t in environment e is 100 t + e, its next observation adds 0.5, and
    # its reward is t + 1.
    steps = max(steps, n_steps)
    terminated, truncated = np.zeros((20, WIDTH), bool), np.zeros((20, WIDTH), bool)
    for t, e, is_terminal in ends:
        (terminated if is_terminal else truncated)[t, e] = True
    replay = replay_of(n_steps)
    for t in range(steps):
        seen = 100.0 * t + torch.arange(WIDTH).unsqueeze(1)
        replay.add_actions(seen, torch.full((WIDTH,), t % 4))
        died, cut = torch.from_numpy(terminated[t]), torch.from_numpy(truncated[t])
        replay.add_outcomes(torch.full((WIDTH,), t + 1.0), died, cut, seen + 0.5)
    data = replay.transitions
    rows = data.draw(64, [torch.Generator()] * AGENTS)
    batch = data.batch(rows)
    for row in range(len(rows)):
        t, e = divmod(int(batch.observations.vector[row]), 100)
        # The rows of the first agent come first, and it has the first environments.
        assert e // ENVS == row // 64
        assert max(0, steps - SLOTS) <= t <= steps - n_steps
        assert batch.actions[row] == t % 4
        reward, last = 0.0, t
        for last in range(t, t + n_steps):
            reward += GAMMA ** (last - t) * (last + 1)
            if terminated[last, e] or truncated[last, e]:
                break
        assert batch.rewards[row] == reward
        assert batch.next_observations.vector[row] == 100 * last + e + 0.5
        assert batch.discounts[row] == (0 if terminated[last, e] else GAMMA ** (last - t + 1))


def test_all_transitions_of_an_agent_are_drawn() -> None:
    replay = replay_of(1)
    for t in range(SLOTS + 2):
        seen = 100.0 * t + torch.arange(WIDTH).unsqueeze(1)
        replay.add_actions(seen, torch.zeros(WIDTH, dtype=torch.int64))
        no = torch.zeros(WIDTH, dtype=torch.bool)
        replay.add_outcomes(torch.zeros(WIDTH), no, no, seen)
    data = replay.transitions
    rows = data.draw(600, [torch.Generator()] * AGENTS)
    for agent, mine in enumerate(data.batch(rows).observations.vector.view(AGENTS, -1)):
        own = range(agent * ENVS, (agent + 1) * ENVS)
        expected = {100.0 * t + e for t in range(2, SLOTS + 2) for e in own}
        assert set(mine.tolist()) == expected
