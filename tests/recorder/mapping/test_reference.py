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
Recording = tuple[Messages, Messages]
Episode = tuple[list[float], list[int], list[float], bool, str]


def steps(odom: Messages, mode: Messages, clock: str) -> list[list[float]]:
    """Return the times of the steps of a recording, one list for each part without a gap."""
    seen = [time for time, _ in odom]
    every = sorted([*seen, *(time for time, _ in mode)])
    parts: list[list[float]] = []
    for time, before in zip(seen, [every[0], *seen], strict=False):
        if not parts or time - before > GAP_S:
            parts.append([time])
        parts[-1].append(time)
    if seen[0] - every[0] <= GAP_S:
        parts[0].insert(0, every[0])
    found = []
    for part, after in zip(parts, [*parts[1:], [every[-1] + 1e-9]], strict=True):
        ticks = {"rate": [part[0] + k / RATE_HZ for k in range(1000)], "odom": seen}
        ticks["mode"] = [time for time, _ in mode]
        times = [time for time in ticks[clock] if part[0] <= time < after[0]]
        late = [time for time in times if time >= part[-1]]
        found.append([time for time in times if not late or time <= late[0]])
    return found


def slow(odom: Messages, mode: Messages, clock: str) -> list[Episode]:
    """Return observations, actions, rewards, termination and end reason of each episode."""
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

    # Steps that are far apart are not in the same episode either.
    parts = list[list[float]]()
    for part in steps(odom, mode, clock):
        for time, before in zip(part, [-GAP_S - 1, *part], strict=False):
            if time - before > GAP_S:
                parts.append([])
            parts[-1].append(time)
    for part in parts:
        for time, until in zip(part, [*part[1:], part[-1] + 1 / RATE_HZ], strict=True):
            speeds = [message for message in odom if message[0] <= time]
            modes = [message for message in mode if message[0] < until]
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
        is_end = part is parts[-1] and max(odom + mode)[0] - odom[-1][0] <= GAP_S
        end(False, "end_of_data" if is_end else "gap")
    return episodes


def messages(values: int) -> Any:
    # Multiples of 0.25 s are exact in nanoseconds and as floats.
    one = st.tuples(st.integers(0, 80).map(lambda k: k / 4), st.integers(0, values).map(float))
    return st.lists(one, min_size=1, max_size=25, unique_by=lambda each: each[0]).map(sorted)


def bag_of(odom: Messages, mode: Messages) -> MemoryBag:
    return MemoryBag(
        {
            "/odom": ([t for t, _ in odom], {"speed": [value for _, value in odom]}),
            "/mode": ([t for t, _ in mode], {"data": [value for _, value in mode]}),
        }
    )


@settings(deadline=None)
@given(
    st.lists(st.tuples(messages(6), messages(2)), min_size=1, max_size=3),
    st.sampled_from(["rate", "odom", "mode"]),
)
def test_columns_equal_a_reading_message_by_message(
    recordings: list[Recording], clock: str
) -> None:
    ticks = {"rate_hz": RATE_HZ} if clock == "rate" else {"topic": f"/{clock}"}
    mapping = parse_mapping(
        {
            "clock": ticks,
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
    expected = [episode for each in recordings for episode in slow(*each, clock)]
    try:
        bag = MemoryBag.together(*(bag_of(*each) for each in recordings))
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
    if clock == "rate":
        assert all(np.diff(e.log_time_ns).min() == 1e9 / RATE_HZ for e in data.episodes)


@st.composite
def drives(draw: Any) -> Messages:
    """Return messages of a topic: a random rate, jitter in the order of recording, and pauses."""
    period_s = draw(st.sampled_from([0.02, 0.1, 0.5]))
    jitter = st.floats(-1.4, 1.4).map(lambda share: share * period_s)
    time, found = draw(st.sampled_from([0.0, 10.0, 900_000.0])), list[tuple[float, float]]()
    for count in draw(st.lists(st.integers(1, 12), min_size=1, max_size=3)):
        found += [(time + k * period_s + draw(jitter), len(found) + float(k)) for k in range(count)]
        time += count * period_s + draw(st.sampled_from([0.4, 3.0, 80_000.0]))
    return [(max(each, 0.0), value) for each, value in found]


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.tuples(drives(), drives()), min_size=2, max_size=4),
    st.sampled_from(["last", "nearest", "linear"]),
    st.sampled_from([{"rate_hz": 20}, {"rate_hz": 3}, {"topic": "/odom"}, {"topic": "/mode"}]),
    st.sampled_from([1.0, 2.0]),
)
def test_recordings_have_the_same_transitions_together_as_apart(
    recordings: list[Recording], align: str, clock: dict[str, Any], gap_s: float
) -> None:
    mapping = parse_mapping(
        {
            "clock": clock,
            "observation": {"speed": {"field": "/odom.speed", "align": align}},
            "action": {"fields": ["/mode.data"], "box": {"low": -1, "high": 99}},
            "episodes": {"gap_s": gap_s, "min_steps": 1},
        }
    )

    def episodes(bag: MemoryBag) -> list[Any]:
        try:
            data = read_open_bag(bag, mapping).dataset
        except LogError:
            return []
        return [
            (e.observations.tolist(), e.next_observations[-1].tolist(), e.actions.tolist())
            for e in data.episodes
        ]

    apart = sorted(recordings, key=lambda each: min(time for part in each for time, _ in part))
    together = episodes(MemoryBag.together(*(bag_of(*each) for each in apart)))
    assert together == [e for each in apart for e in episodes(bag_of(*each))]
    # Nothing is observed twice, but for a rate above that of the messages.
    if clock == {"topic": "/odom"}:
        for observations, last, _ in together:
            values = [value for (value,) in observations] + last
            assert len(set(values)) == len(values) or align == "linear"
