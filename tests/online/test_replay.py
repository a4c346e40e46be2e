"""Tests of the replay buffer against slow references."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.architecture import Architecture
from mcaprl.offline.batches.observations import ObservationEncoder, Observations
from mcaprl.offline.batches.packing import Packing
from mcaprl.online.replay import Outcome, ReplayBuffer, averaged, shifted

AGENTS, ENVS, CAPACITY, GAMMA = 2, 3, 6, 0.5
WIDTH = AGENTS * ENVS
CPU = torch.device("cpu")
VECTOR = spaces.Box(-np.inf, np.inf, (1,))


def replay_of(
    space: spaces.Space[Any] = VECTOR,
    actions: spaces.Space[Any] | None = None,
    *,
    image_shift: int = 0,
    **packing: Any,
) -> ReplayBuffer:
    """Return an empty buffer."""
    return ReplayBuffer.allocate(
        ObservationEncoder(space, 4),
        actions or spaces.Discrete(4),
        Packing(gamma=GAMMA, **packing),
        Architecture((8,), encoder="compact"),
        agents=AGENTS,
        envs=ENVS,
        size=CAPACITY * ENVS,
        device=CPU,
        seed=0,
        image_shift=image_shift,
    )


def seen(t: float) -> Observations:
    """Return the observations 100 t + e of all environments e."""
    return Observations(100.0 * t + torch.arange(WIDTH, dtype=torch.float32).unsqueeze(1))


def outcome_of(t: int, died: torch.Tensor, cut: torch.Tensor, *, all_finals: bool) -> Outcome:
    """Return the outcome of step t.

    The reward is t + 1. The last observation of an episode adds 0.5 to that of the next one.
    """
    finals = Observations(seen(t + 1).vector + 0.5)
    ended = None if all_finals else (died | cut).nonzero().squeeze(1)
    rewards = torch.full((WIDTH,), t + 1.0)
    if ended is not None:
        finals = finals.rows(ended)
    return Outcome(rewards, died, cut, seen(t + 1), finals, ended)


class Reference:
    """Stacks, n-step returns and next observations of the steps so far, one by one."""

    def __init__(self, died: Any, cut: Any, breaks: set[int], steps: int) -> None:
        self.died, self.cut, self.breaks, self.steps = died, cut, breaks, steps

    def ends(self, t: int, e: int) -> bool:
        """Whether step t ends the episode; all episodes are broken off before steps in `breaks`."""
        return bool(self.died[t, e] or self.cut[t, e]) or t + 1 in self.breaks

    def first(self, t: int, e: int) -> int:
        while t > 0 and not self.ends(t - 1, e):
            t -= 1
        return t

    def stack(self, t: int, e: int, count: int) -> list[float]:
        return [100.0 * max(t - k, self.first(t, e)) + e for k in range(count)][::-1]

    def transition(
        self, t: int, e: int, n_steps: int, count: int
    ) -> tuple[float, float, list[float]]:
        reward, last = 0.0, t
        for last in range(t, min(t + n_steps, self.steps)):
            reward += GAMMA ** (last - t) * (last + 1)
            if self.ends(last, e):
                break
        discount = 0.0 if self.died[last, e] else GAMMA ** (last - t + 1)
        natural = bool(self.died[last, e] or self.cut[last, e])
        newest = 100.0 * (last + 1) + e + (0.5 if natural else 0.0)
        if not self.ends(last, e):
            return reward, discount, self.stack(last + 1, e, count)
        before = self.stack(last, e, count)
        return reward, discount, [*before[1:], newest]


@given(
    n_steps=st.integers(1, 4),
    frame_stack=st.integers(1, 4),
    steps=st.integers(1, 20),
    ends=st.lists(st.tuples(st.integers(0, 19), st.integers(0, WIDTH - 1), st.booleans())),
    breaks=st.sets(st.integers(1, 19), max_size=3),
    all_finals=st.booleans(),
)
def test_a_batch_has_the_returns_and_stacks_of_the_recorded_steps(
    n_steps: int,
    frame_stack: int,
    steps: int,
    ends: list[tuple[int, int, bool]],
    breaks: set[int],
    all_finals: bool,
) -> None:
    died, cut = torch.zeros(20, WIDTH, dtype=torch.bool), torch.zeros(20, WIDTH, dtype=torch.bool)
    for t, e, is_terminal in ends:
        (died if is_terminal else cut)[t, e] = True
    breaks = {t for t in breaks if t < steps}
    buffer = replay_of(n_steps=n_steps, frame_stack=frame_stack)
    reference = Reference(died, cut, breaks, steps)
    buffer.begin(seen(0))
    for t in range(steps):
        if t in breaks:
            # The seed of a new episode determines its first observation, here as without a break.
            buffer.begin(seen(t))
        expected = [reference.stack(t, e, frame_stack) for e in range(WIDTH)]
        assert buffer.now().vector.tolist() == expected
        actions = torch.full((WIDTH,), t % 4)
        buffer.add(actions, outcome_of(t, died[t], cut[t], all_finals=all_finals))
    other = replay_of(n_steps=n_steps, frame_stack=frame_stack)
    other.load_state({name: tensor.clone() for name, tensor in buffer.state().items()})
    for data in (buffer, other):
        rows = data.draw(64, [])
        batch = data.batch(rows)
        for row in range(len(rows)):
            stack = batch.observations.vector[row].tolist()
            t, e = divmod(int(stack[-1]), 100)
            # The rows of the first agent come first, and it has the first environments.
            assert e // ENVS == row // 64
            assert max(0, steps - CAPACITY) <= t < steps
            assert stack == reference.stack(t, e, frame_stack)
            assert batch.actions[row] == t % 4
            reward, discount, after = reference.transition(t, e, n_steps, frame_stack)
            assert batch.rewards[row] == reward
            assert batch.discounts[row] == discount
            assert batch.next_observations.vector[row].tolist() == after
    assert torch.equal(buffer.draw(64, []), other.draw(64, []))


def test_all_transitions_of_an_agent_are_drawn() -> None:
    buffer = replay_of()
    no = torch.zeros(WIDTH, dtype=torch.bool)
    buffer.begin(seen(0))
    for t in range(CAPACITY + 2):
        buffer.add(torch.zeros(WIDTH, dtype=torch.int64), outcome_of(t, no, no, all_finals=False))
    rows = buffer.draw(600, [])
    for agent, mine in enumerate(buffer.batch(rows).observations.vector.view(AGENTS, -1)):
        own = range(agent * ENVS, (agent + 1) * ENVS)
        expected = {100.0 * t + e for t in range(2, CAPACITY + 2) for e in own}
        assert set(mine.tolist()) == expected


def test_actions_may_be_numbers_of_any_shape() -> None:
    buffer = replay_of(actions=spaces.Box(-1, 1, (2,)))
    no = torch.zeros(WIDTH, dtype=torch.bool)
    buffer.begin(seen(0))
    actions = torch.rand(WIDTH, 2)
    buffer.add(actions, outcome_of(0, no, no, all_finals=False))
    torch.testing.assert_close(buffer.batch(torch.arange(WIDTH)).actions, actions)


IMAGES = spaces.Dict(
    {"depth": spaces.Box(0, 255, (84, 85, 1), np.uint8), "speed": spaces.Box(-1, 1, (2,))}
)


def test_images_are_stored_averaged_once_and_shifted_together() -> None:
    random = np.random.default_rng(0)
    buffer = replay_of(IMAGES, image_shift=3)
    images = random.integers(256, size=(WIDTH, 84, 85, 1), dtype=np.uint8)
    speeds = random.normal(size=(WIDTH, 2)).astype(np.float32)
    encoded = buffer.encoder.encode({"depth": images, "speed": speeds})
    assert buffer.frames.images[0].shape[1:] == (42, 42, 1)
    buffer.begin(encoded)
    squares = images[:, :, :84].reshape(WIDTH, 42, 2, 42, 2, 1).astype(float)
    expected = np.floor(squares.mean((2, 4)) + 0.5)
    np.testing.assert_array_equal(buffer.now().images[0], expected)
    no = torch.zeros(WIDTH, dtype=torch.bool)
    buffer.add(
        torch.zeros(WIDTH, dtype=torch.int64),
        Outcome(
            torch.zeros(WIDTH), no, no, encoded, encoded.rows(torch.arange(0)), torch.arange(0)
        ),
    )
    found: set[tuple[int, int]] = set()
    for _ in range(40):
        rows = buffer.draw(4, [])
        batch = buffer.batch(rows)
        stored = buffer.frames.rows(rows).images[0]
        here, there = buffer.counts.shifts
        found.update((here, there))
        torch.testing.assert_close(batch.observations.images[0], shifted(stored, *here))
        torch.testing.assert_close(batch.next_observations.images[0], shifted(stored, *there))
        torch.testing.assert_close(batch.observations.vector, encoded.vector[rows])
    assert {down for down, _ in found} == {right for _, right in found} == set(range(-3, 4))


def test_shifted_images_repeat_their_edges() -> None:
    image = torch.arange(6).view(1, 2, 3, 1)
    assert shifted(image, 1, 0)[0, :, :, 0].tolist() == [[0, 1, 2], [0, 1, 2]]
    assert shifted(image, 0, -2)[0, :, :, 0].tolist() == [[2, 2, 2], [5, 5, 5]]


@pytest.mark.parametrize(
    ("values", "mean"), [((0, 1, 1, 0), 1), ((0, 1, 0, 0), 0), ((255,) * 4, 255)]
)
def test_averages_are_rounded(values: tuple[int, ...], mean: int) -> None:
    image = torch.tensor(values, dtype=torch.uint8).view(1, 2, 2, 1)
    assert averaged(image, 2).tolist() == [[[[mean]]]]


def test_masks_belong_to_the_observations() -> None:
    space = spaces.Dict(
        {"action_mask": spaces.Box(0, 1, (4,), np.int8), "position": spaces.Box(-1, 1, (1,))}
    )
    buffer = replay_of(space, frame_stack=2)
    masks = np.eye(4, dtype=np.int8)[np.arange(WIDTH) % 4]
    position = np.zeros((WIDTH, 1), np.float32)
    buffer.begin(buffer.encoder.encode({"action_mask": masks, "position": position}))
    assert buffer.now().vector.shape == (WIDTH, 2)
    np.testing.assert_array_equal(buffer.now().mask, masks.astype(bool))
