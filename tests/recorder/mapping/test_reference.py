"""For random streams, reading by columns equals a slow reference that reads single messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mcaprl.errors import LogError
from mcaprl.recorder.mapping.config import parse_mapping
from mcaprl.recorder.mapping.read import read_open_bag
from tests.support.memory_bag import MemoryBag

GAP_S, RATE_HZ, MAX_STEPS = 3.0, 2, 4
Messages = list[tuple[float, float]]
Episode = tuple[list[float], list[int], list[float], bool, str]


def slow(odom: Messages, mode: Messages) -> list[Episode]:
    """Return observations, actions, rewards, termination and end reason of each episode."""
    every = [time for time, _ in odom + mode]
    count = int((max(every) - min(every)) * RATE_HZ + 1e-6) + 1
    times = [min(every) + k / RATE_HZ for k in range(count)]
    episodes: list[Episode] = []
    observations: list[float] = []
    actions: list[int] = []

    def end(terminated: bool, reason: str) -> None:
        if len(observations) > 1:
            seen, taken = list(observations), actions[: len(observations) - 1]
            rewards = [b - a + t for a, b, t in zip(seen, seen[1:], taken, strict=False)]
            episodes.append((seen, taken, rewards, terminated, reason))
        observations.clear()
        actions.clear()

    for time in times:
        speeds = [message for message in odom if message[0] <= time]
        modes = [message for message in mode if message[0] < time + 1 / RATE_HZ]
        if not speeds or time - speeds[-1][0] > GAP_S:
            end(False, "gap")
            continue
        speed, is_acted = speeds[-1][1], bool(modes)
        is_terminal = speed == 5
        if not observations and (is_terminal or not is_acted):
            continue
        observations.append(speed)
        actions.append(int(modes[-1][1]) if is_acted else -1)
        if is_terminal or len(observations) > MAX_STEPS:
            end(is_terminal, "terminated" if is_terminal else "time_limit")
    end(False, "end_of_data")
    return episodes


def messages(values: int) -> Any:
    # Multiples of 0.25 s are exact in nanoseconds and as floats.
    one = st.tuples(st.integers(0, 60).map(lambda k: k / 4), st.integers(0, values).map(float))
    return st.lists(one, min_size=1, max_size=25).map(
        lambda found: sorted(found, key=lambda m: m[0])
    )


@settings(deadline=None)
@given(messages(6), messages(2))
def test_columns_equal_a_reading_message_by_message(odom: Messages, mode: Messages) -> None:
    bag = MemoryBag(
        {
            "/odom": ([t for t, _ in odom], {"speed": [value for _, value in odom]}),
            "/mode": ([t for t, _ in mode], {"data": [value for _, value in mode]}),
        }
    )
    mapping = parse_mapping(
        {
            "clock": {"rate_hz": RATE_HZ},
            "observation": {"speed": {"field": "/odom.speed"}},
            "action": {"field": "/mode.data"},
            "reward": "next(speed) - speed + action",
            "episodes": {
                "gap_s": GAP_S,
                "max_steps": MAX_STEPS,
                "terminated": "speed == 5",
                "min_steps": 1,
            },
        }
    )
    expected = slow(odom, mode)
    try:
        data = read_open_bag(bag, mapping).dataset
    except LogError:
        assert expected == []
        return
    found = [
        (
            [*e.observations.ravel().tolist(), float(e.next_observations[-1, 0])],
            e.actions.tolist(),
            e.rewards.tolist(),
            bool(e.terminated[-1]),
            e.reason,
        )
        for e in data.episodes
    ]
    assert found == expected
    assert all(np.diff(e.log_time_ns).min() == 1e9 / RATE_HZ for e in data.episodes)
