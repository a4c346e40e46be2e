"""Datasets from bags in memory, with numbers calculated by hand."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.mapping.config import Mapping, parse_mapping
from mcaprl.recorder.mapping.read import MappedBag, read_open_bag
from tests.support.memory_bag import SECOND_NS, MemoryBag


def mapping(**parts: Any) -> Mapping:
    """Return a mapping with the observation `speed`, a discrete action, and a rate of 1 Hz."""
    tree = {
        "clock": {"rate_hz": 1},
        "observation": {"speed": {"field": "/odom.speed"}},
        "action": {"field": "/mode.data"},
        **parts,
    }
    return parse_mapping(tree)


def drive(seconds: int = 6, **topics: Any) -> MemoryBag:
    """Return a bag whose speed equals the time in seconds.

    The modes are 0, 1, 0, ..., each 0.1 s after a speed.
    """
    times = list(range(seconds))
    return MemoryBag(
        {
            "/odom": (times, {"speed": [float(t) for t in times]}),
            "/mode": ([t + 0.1 for t in times], {"data": [float(t % 2) for t in times]}),
            **topics,
        }
    )


def read(bag: MemoryBag, **parts: Any) -> MappedBag:
    return read_open_bag(bag, mapping(**parts))


def test_transitions_by_hand() -> None:
    data, report = read(drive(), reward="next(speed) - speed + 10 * action")
    assert data.observations.tolist() == [[0.0], [1.0], [2.0], [3.0], [4.0]]
    assert data.next_observations.tolist() == [[1.0], [2.0], [3.0], [4.0], [5.0]]
    assert data.actions.tolist() == [0, 1, 0, 1, 0]
    assert data.rewards.tolist() == [1, 11, 1, 11, 1]
    assert data.truncated.tolist() == [False] * 4 + [True]
    assert not data.terminated.any()
    assert np.isnan(data.behavior_probs).all()
    assert data.action_space == spaces.Discrete(2)
    assert data.observation_names == ("speed",)
    episode = data.episodes[0]
    assert episode.log_time_ns.tolist() == [t * SECOND_NS for t in range(6)]
    assert episode.summary.reason == "end_of_data"
    assert report.action_counts == {"0": 3, "1": 2}
    assert (report.clock_steps, report.steps, report.dropped) == (6, 5, [])


def test_the_action_is_the_last_command_before_the_next_step() -> None:
    commands = MemoryBag(
        {
            "/odom": ([0, 1, 2, 3], {"speed": [0.0, 1.0, 2.0, 3.0]}),
            "/mode": ([0.2, 0.9, 1.0, 2.5], {"data": [5.0, 1.0, 2.0, 0.0]}),
        }
    )
    assert read(commands).dataset.actions.tolist() == [1, 2, 0]
    action = {"field": "/mode.data", "align": "nearest"}
    assert read(commands, action=action).dataset.actions.tolist() == [5, 2, 0]
    action = {"field": "/mode.data", "align": "last"}
    # There is no command up to 0 s, so the first episode begins at 1 s.
    found = read(commands, action=action).dataset
    assert found.observations.tolist() == [[1.0], [2.0]]
    assert found.actions.tolist() == [2, 2]


def test_nothing_is_taken_from_the_future() -> None:
    late = MemoryBag(
        {
            "/odom": ([0.01, 1.01, 2.01, 3.01], {"speed": [0.0, 1.0, 2.0, 3.0]}),
            "/mode": ([0, 1, 2, 3, 4], {"data": [1.0] * 5}),
        }
    )
    assert read(late).dataset.observations.tolist() == [[0.0], [1.0], [2.0]]
    nearest = {"speed": {"field": "/odom.speed", "align": "nearest"}}
    found = read(late, observation=nearest).dataset.observations
    assert found.tolist() == [[0.0], [1.0], [2.0], [3.0]]


def test_values_are_scaled_wrapped_clipped_and_sliced() -> None:
    bag = drive(
        4,
        **{
            "/scan": ([0, 1, 2, 3], {"ranges": [[1.0, 2.0, math.inf, 40.0]] * 4}),
            "/pose": ([0, 1, 2, 3], {"angle": [3.0, 4.0, 7.0, -4.0], "bad": [math.nan] * 4}),
        },
    )
    observation = {
        "near": {"field": "/scan.ranges[1:3]", "scale": 0.5, "offset": 1, "missing": 9},
        "last": {"field": "/scan.ranges[-1]", "clip": [0, 30]},
        "heading": {"field": "/pose.angle", "wrap_angle": True},
        "none": {"field": "/pose.bad", "missing": -1},
    }
    data, report = read(bag, observation=observation)
    assert data.observation_names == ("near_0", "near_1", "last", "heading", "none")
    np.testing.assert_allclose(
        data.observations[1], [2.0, 9.0, 30.0, 4.0 - 2 * math.pi, -1.0], rtol=1e-6
    )
    space: Any = data.observation_space
    assert space.low.tolist() == [-np.inf, -np.inf, 0.0, -np.inf, -np.inf]
    assert report.fields["none"].missing == 1.0
    assert report.fields["last"].missing == 0.0


def test_the_space_contains_the_number_for_missing_values() -> None:
    bag = drive(4, **{"/late": ([1.5], {"x": [20.0]})})
    late = {"field": "/late.x", "clip": [0, 10], "missing": -5}
    data = read(bag, observation={"late": late}).dataset
    assert data.frames.ravel().tolist() == [-5, -5, 10, 10]
    space: Any = data.observation_space
    assert (space.low.tolist(), space.high.tolist()) == ([-5], [10])


def test_yaw_of_quaternions_by_hand() -> None:
    half = math.sqrt(0.5)
    columns = {"q.x": [0.0] * 3, "q.y": [0.0] * 3, "q.z": [0.0, half, 0.0], "q.w": [1.0, half, 0.0]}
    bag = drive(3, **{"/pose": ([0, 1, 2], columns)})
    observation = {"yaw": {"field": "/pose.q", "as": "yaw", "missing": 9}}
    data = read(bag, observation=observation).dataset
    np.testing.assert_allclose(data.frames[:, 0], [0.0, math.pi / 2, 9.0], atol=1e-7)


def test_commands_become_named_actions_and_bins_and_boxes() -> None:
    bag = MemoryBag(
        {
            "/odom": ([0, 1, 2, 3], {"speed": [0.0, 1.0, 2.0, 3.0]}),
            "/cmd": ([0, 1, 2], {"v": [0.9, 0.0, 0.4], "w": [0.05, 0.0, -1.0]}),
        }
    )
    fields = ["/cmd.v", "/cmd.w"]
    named = {"fields": fields, "actions": {"stop": [0, 0], "go": [1, 0], "turn": [0, -1]}}
    data, report = read(bag, action=named)
    assert data.actions.tolist() == [1, 0, 2]
    assert data.action_names == {0: "stop", 1: "go", 2: "turn"}
    # The third command is assigned to `turn`. Its `v` differs from that of `turn` by 0.4, which is
    # more than a quarter of the range.
    assert report.far_actions == pytest.approx(1 / 3)
    assert report.action_counts == {"stop": 1, "go": 1, "turn": 1}
    binned: dict[str, Any] = {"fields": fields, "edges": [[0.3, 0.8], [0.0]]}
    data = read(bag, action=binned).dataset
    assert data.actions.tolist() == [5, 1, 2]
    assert data.action_names[2] == "v 0.3 to 0.8 and w below 0"
    by_bins = {**binned, "bins": [["stopped", "slow", "fast"], ["right", "left"]]}
    data = read(bag, action=by_bins).dataset
    assert data.actions.tolist() == [5, 1, 2]
    assert data.action_names[2] == "slow, right"
    data, report = read(bag, action={"fields": fields, "box": {"low": [0, -0.5], "high": [1, 1]}})
    np.testing.assert_allclose(data.actions, [[0.9, 0.05], [0.0, 0.0], [0.4, -0.5]], rtol=1e-6)
    assert report.far_actions == pytest.approx(1 / 3)


def test_commands_are_expressions() -> None:
    times = [0, 1, 2, 3, 4]
    bag = MemoryBag(
        {
            "/odom": (times, {"speed": [0.0, 1.0, 3.0, 6.0, 10.0]}),
            "/arm": ([0, 1, 3, 4], {"q": [[0.0, 5.0], [1.0, 5.0], [1.0, 9.0], [math.nan, 2.0]]}),
        }
    )
    quantities = {
        "observation": {"speed": {"field": "/odom.speed"}},
        "fields": {"arm": {"field": "/arm.q"}},
    }
    deltas = ["next(speed) - speed", "next(arm[1]) - arm[1]"]
    boxed = {"expressions": deltas, "box": {"low": -1, "high": [2, 3]}}
    data, report = read(bag, **quantities, action=boxed, reward="speed")
    assert data.actions.tolist() == [[1, 0], [2, 0], [2, 3], [2, -1]]
    assert report.far_actions == 0.5
    # The last value of arm[0] is missing, and there is no action where the result is.
    data, report = read(
        bag, **quantities, action={"expressions": ["next(arm[0]) - speed"], "edges": [[0, 1]]}
    )
    assert data.actions.tolist() == [2, 1, 0]
    assert data.action_names[1] == "next(arm[0]) - speed 0 to 1"
    assert report.missing_actions == 0.4
    named = {"expressions": deltas, "actions": {"stay": [0, 0], "up": [3, 4]}}
    assert read(bag, **quantities, action=named).dataset.actions.tolist() == [0, 0, 1, 0]
    with pytest.raises(UsageError, match=r"action.expressions.1: unknown name .* 'spe'"):
        read(bag, **quantities, action={**boxed, "expressions": ["speed", "spe"]})
    with pytest.raises(UsageError, match=r"expressions.0: 'arm' must be one number for each row"):
        read(bag, **quantities, action={"expressions": ["arm"], "box": {"low": 0, "high": 1}})


def test_episodes_end_by_conditions_gaps_and_limits() -> None:
    times = [0, 1, 2, 3, 4, 5, 6, 7, 20, 21, 22]
    bag = MemoryBag(
        {
            "/odom": (times, {"speed": [0, 1, 2, 9, 1, 1, 1, 1, 1, 1, 1.0]}),
            "/mode": (times, {"data": [1.0] * len(times)}),
        }
    )
    data, report = read(
        bag,
        clock={"topic": "/odom"},
        episodes={"terminated": "speed > 5", "reasons": {"too_fast": "speed > 8"}},
        reward="-1 * terminated",
    )
    assert [episode.length for episode in data.episodes] == [3, 3, 2]
    assert [episode.reason for episode in data.episodes] == ["too_fast", "gap", "end_of_data"]
    assert data.terminated.tolist() == [False, False, True] + [False] * 5
    assert data.rewards.tolist() == [0, 0, -1] + [0] * 5
    assert report.ends == {"condition": 1, "gap": 1, "end_of_data": 1}
    data = read(bag, clock={"topic": "/odom"}, episodes={"max_steps": 2}).dataset
    assert [(e.length, e.reason) for e in data.episodes] == [
        (2, "time_limit"),
        (2, "time_limit"),
        (2, "time_limit"),
    ]


def test_a_condition_on_a_missing_value_is_false() -> None:
    bag = drive(6, **{"/bumper": ([2.5, 3.5], {"on": [0.0, 1.0]})})
    fields = {"bumper": {"field": "/bumper.on"}, "cliff": {"field": "/odom.speed", "scale": 0}}
    data = read(bag, fields=fields, episodes={"terminated": "bumper or cliff"}).dataset
    assert [(each.length, each.reason) for each in data.episodes] == [(4, "terminated")]
    data = read(bag, fields=fields, episodes={"terminated": "not cliff and bumper != 0"}).dataset
    assert [each.length for each in data.episodes] == [4]
    with pytest.raises(UsageError, match="the reward is nan at 0 ns; it is not finite in 3 of 5"):
        read(bag, fields=fields, reward="1 if bumper else 0")


def test_a_rising_edge_begins_an_episode() -> None:
    times = list(range(9))
    bag = MemoryBag(
        {
            "/odom": (times, {"speed": [float(t) for t in times]}),
            "/mode": (times, {"data": [0.0] * 9}),
            "/on": (times, {"data": [0, 1, 1, 1, 0, 0, 1, 1, 1.0]}),
        }
    )
    data = read(
        bag,
        fields={"on": {"field": "/on.data"}},
        episodes={"begin": "on == 1", "end": "on == 0"},
    ).dataset
    assert data.observations.ravel().tolist() == [1, 2, 3, 6, 7]
    assert [episode.reason for episode in data.episodes] == ["truncated", "end_of_data"]


def test_an_event_begins_an_episode() -> None:
    times = list(range(8))
    bag = MemoryBag(
        {
            "/odom": (times, {"speed": [float(t) for t in times]}),
            "/mode": (times, {"data": [0.0] * 8}),
            "/start/_service_event": ([0.5, 4.5], {"info.event_type": [0.0, 0.0]}),
        }
    )
    data = read(
        bag,
        fields={"starts": {"field": "/start/_service_event", "as": "count"}},
        episodes={"begin": "next(starts) > starts"},
    ).dataset
    assert [e.observations.ravel().tolist() for e in data.episodes] == [[0, 1, 2], [4, 5, 6]]
    assert data.episodes[0].reason == "restarted"


def test_constants_of_the_types_are_names_in_expressions() -> None:
    bag = drive()
    info = bag.topics["/mode"]
    bag.topics["/mode"] = dataclasses.replace(info, constants={"TURBO": 1})
    data = read(bag, reward="7 if action == TURBO else 0").dataset
    assert data.rewards.tolist() == [0, 7, 0, 7, 0]


def test_short_episodes_are_dropped_and_reported() -> None:
    found = read(drive(), episodes={"terminated": "speed == 1", "min_steps": 2})
    assert found.report.dropped == [1]
    assert found.dataset.observations.ravel().tolist() == [2.0, 3.0, 4.0]


def test_a_topic_that_stops_ends_the_episode() -> None:
    bag = MemoryBag(
        {
            "/odom": ([0, 1, 2, 3], {"speed": [0.0, 1.0, 2.0, 3.0]}),
            "/mode": (list(range(10)), {"data": [1.0] * 10}),
        }
    )
    found = read(bag, episodes={"gap_s": 2})
    # The last step is that of the last speed, because nothing new is observed after it.
    assert found.dataset.observations.ravel().tolist() == [0, 1, 2]
    assert found.dataset.frames.ravel().tolist() == [0, 1, 2, 3]
    assert found.dataset.episodes[0].reason == "gap"
    assert found.report.fields["speed"].max_age_s == 0.0


def test_late_starts_and_duplicate_stamps() -> None:
    bag = MemoryBag(
        {
            "/odom": ([3, 4, 4, 5, 6], {"speed": [3.0, 40.0, 41.0, 5.0, 6.0]}),
            "/mode": (list(range(7)), {"data": [1.0] * 7}),
        }
    )
    found = read(bag)
    assert found.dataset.observations.ravel().tolist() == [3, 41, 5]
    # There are no steps in the gap before the first speed.
    assert (found.report.clock_steps, found.report.fields["speed"].missing) == (4, 0.0)
    found = read(bag, episodes={"gap_s": 3})
    assert found.report.fields["speed"].missing == pytest.approx(3 / 7)


def test_jitter_is_sorted_and_a_reset_of_the_clock_divides_the_bag() -> None:
    times = [0, 1, 2.2, 2.1, 3, 0.5, 1.5, 2.5]
    bag = MemoryBag(
        {
            "/odom": (times, {"speed": [0, 1, 3, 2, 4, 10, 11, 12.0]}),
            "/mode": (times, {"data": [0.0] * 8}),
        }
    )
    found = read(bag, clock={"topic": "/odom"}, episodes={"gap_s": 1.5})
    assert found.report.clock_resets == 1
    assert [len(e.observations) for e in found.dataset.episodes] == [4, 2]
    assert found.dataset.observations.ravel().tolist() == [0, 1, 2, 3, 10, 11]
    rising = np.concatenate([e.log_time_ns for e in found.dataset.episodes])
    assert (np.diff(rising) > 0).all()
    uneven = MemoryBag(
        {"/odom": (times, {"speed": [0.0] * 8}), "/mode": ([0, 1, 2], {"data": [0.0] * 3})}
    )
    # All modes were recorded before the reset.
    found = read(uneven, episodes={"gap_s": 1.5})
    assert (found.report.clock_resets, found.report.episodes) == (1, 1)


def test_headers_and_publish_times_are_times() -> None:
    stamps = np.array([0, 1, 2, 3], np.int64) * SECOND_NS
    # Only `/tf` and `/tf_static` have no header, not each topic whose name begins with `/tf`.
    for topic in ("/odom", "/tf_mini"):
        bag = MemoryBag(
            {
                topic: ([5, 6, 7, 8], {"speed": [0, 1, 2, 3.0], "header.stamp": stamps}),
                "/mode": ([9, 9, 9, 9], {"data": [0, 1, 0, 1.0], "header.stamp": stamps + 10}),
            }
        )
        found = read(bag, time="header", observation={"speed": {"field": f"{topic}.speed"}})
        assert found.dataset.actions.tolist() == [0, 1, 0]
        assert found.dataset.episodes[0].log_time_ns[0] == 0
    with pytest.raises(UsageError, match=r"/odom \(memory\) has no header.stamp: use `time: log_t"):
        read(drive(), time="header")


def test_stacked_observations_repeat_the_first() -> None:
    data = read(drive(4), stack=3).dataset
    assert data.observations.tolist() == [[0, 0, 0], [0, 0, 1], [0, 1, 2]]
    assert data.observation_names == ("speed_2_ago", "speed_1_ago", "speed")


def test_behavior_probabilities_are_those_of_the_actions() -> None:
    bag = drive(4, **{"/prob": ([0.1, 1.1, 2.1], {"p": [0.5, 0.25, 1.0]})})
    data = read(bag, behavior_prob={"field": "/prob.p"}).dataset
    assert data.behavior_probs.tolist() == [0.5, 0.25, 1.0]


def test_behavior_probabilities_are_aligned_as_the_action() -> None:
    late = [t + 0.5 for t in range(5)]
    bag = drive(
        5,
        **{
            "/mode": (late, {"data": [0.0, 1.0, 2.0, 3.0, 4.0]}),
            "/prob": (late, {"p": [0.1, 0.2, 0.3, 0.4, 0.5]}),
        },
    )
    last = {"field": "/mode.data", "align": "last"}
    prob = {"field": "/prob.p"}
    data = read(bag, clock={"topic": "/odom"}, action=last, behavior_prob=prob).dataset
    # The last command up to 1 s is that of 0.5 s.
    assert data.actions.tolist() == [0, 1, 2]
    np.testing.assert_allclose(data.behavior_probs, [0.1, 0.2, 0.3])
    data = read(bag, clock={"topic": "/odom"}, behavior_prob={**prob, "align": "last"}).dataset
    assert data.actions.tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(data.behavior_probs, [np.nan, 0.1, 0.2, 0.3])


@pytest.mark.parametrize("wrong", [2.0, -0.5, 0.0, math.inf])
def test_impossible_probabilities_are_refused(wrong: float) -> None:
    bag = drive(4, **{"/prob": ([0.1, 1.1, 2.1], {"p": [0.5, wrong, math.nan]})})
    expected = rf"behavior_prob: the probability is {wrong:g} at 1000000000 ns; .* in 1 of 3 steps"
    with pytest.raises(UsageError, match=expected):
        read(bag, behavior_prob={"field": "/prob.p"})
    with pytest.raises(UsageError, match="behavior_prob must be a field"):
        read(bag, behavior_prob={"transform": "base"})


def test_missing_topics_and_empty_bags_are_clear_errors() -> None:
    with pytest.raises(
        UsageError, match=r"mapping: observation.speed: no topic /odo.?; nearest: /odom"
    ):
        read(drive(), observation={"speed": {"field": "/odo.speed"}})
    with pytest.raises(UsageError, match=r"/odom \(memory\) has no field 'sped'; nearest: speed"):
        read(drive(), observation={"speed": {"field": "/odom.sped"}})
    empty = MemoryBag({"/odom": ([], {"speed": []}), "/mode": ([], {"data": []})})
    with pytest.raises(LogError, match="the topics have no messages"):
        read(empty)
    silent = MemoryBag({"/odom": ([0, 1], {"speed": [0.0, 1.0]}), "/mode": ([], {"data": []})})
    with pytest.raises(LogError, match="no step has an action"):
        read(silent)


def test_wrong_units_and_fractional_modes_are_clear_errors() -> None:
    bag = MemoryBag(
        {
            "/odom": ([0, 1, 2], {"speed": [0.0, 1.0, 2.0]}),
            "/mode": ([0, 1, 2], {"data": [0.5, 1.0, 1.0]}),
        }
    )
    with pytest.raises(
        UsageError, match=r"action: /mode.data has the value 0.5; a discrete action"
    ):
        read(bag)
    with pytest.raises(UsageError, match="200000001 steps are too many for 6 messages"):
        read(drive(3), clock={"rate_hz": 1e8})
    far = MemoryBag({"/odom": ([0, 8e9], {"speed": [0, 1]}), "/mode": ([0], {"data": [0]})})
    with pytest.raises(LogError, match="the longest of 2 episodes has 0 steps"):
        read(far, clock={"rate_hz": 1000})


def test_actions_that_cannot_be_read_are_clear_errors() -> None:
    with pytest.raises(
        UsageError, match=r"action: /mode.data has the value 1, which `names` does not contain; na"
    ):
        read(drive(), action={"field": "/mode.data", "names": {"stop": 0, "go": 2}})
    times = [0, 1, 2]
    bag = drive(
        3,
        **{
            "/cmd": (times, {"v": [[1.0, 2.0]] * 3, "text": ["a", "b", "a"], "big": [3e9] * 3}),
        },
    )
    with pytest.raises(UsageError, match=r"/cmd.v has 2 elements; choose one of them, such as "):
        read(bag, action={"field": "/cmd.v"})
    with pytest.raises(UsageError, match=r"action: /cmd.text is not a number"):
        read(bag, action={"fields": ["/cmd.text"], "edges": [[0]]})
    with pytest.raises(UsageError, match=r"has the value 3e\+09; a discrete action is less than"):
        read(bag, action={"field": "/cmd.big"})
    with pytest.raises(UsageError, match="has the value 'b', which `names` does not contain"):
        read(bag, action={"field": "/cmd.text", "names": {"a": 0}})


def test_arrays_without_elements_are_clear_errors() -> None:
    times = [0, 1, 2]
    bag = drive(3, **{"/s": (times, {"b": [[1.0, 2.0]] * 3, "none": np.empty((3, 0))})})
    for field, count in (("/s.b[5:]", 2), ("/s.none", 0), ("/s.none[:]", 0)):
        expected = rf"observation.x: {re.escape(field)}: no elements; the field has {count} elem"
        with pytest.raises(UsageError, match=expected):
            read(bag, observation={"x": {"field": field}})


def test_bytes_are_numbers_and_texts_are_not() -> None:
    times = [0, 1, 2]
    columns = {"b": [b"12", b"13", b"14"], "s": ["1", "2", "3"]}
    bag = drive(3, **{"/raw": (times, columns)})
    data = read(bag, observation={"b": {"field": "/raw.b"}}).dataset
    assert data.observations.tolist() == [[49, 50], [49, 51]]
    data = read(bag, observation={"b": {"field": "/raw.b[1]"}}).dataset
    assert data.observations.ravel().tolist() == [50, 51]
    with pytest.raises(UsageError, match=r"observation.s: s is not a number"):
        read(bag, observation={"s": {"field": "/raw.s"}})


def test_a_reward_that_is_not_a_number_is_refused() -> None:
    bag = drive(4, **{"/late": ([2], {"x": [1.0]})})
    with pytest.raises(
        UsageError, match=r"mapping: reward: the reward is nan at 0 ns; it is not finite in 2 of 3"
    ):
        read(bag, fields={"late": {"field": "/late.x"}}, reward="late")
    found = read(bag, fields={"late": {"field": "/late.x", "missing": 7}}, reward="late")
    assert found.dataset.rewards.tolist() == [7, 7, 1]


def test_code_runs_only_if_it_is_trusted() -> None:
    with pytest.raises(UsageError, match="pass `trust_code=True` if you trust the mapping"):
        read(drive(), reward="tests.recorder.mapping.test_read:double_speed")
    chosen = mapping(reward="tests.recorder.mapping.test_read:double_speed")
    found = read_open_bag(drive(), chosen, trust_code=True)
    assert found.dataset.rewards.tolist() == [0, 2, 4, 6, 8]


def double_speed(columns: dict[str, Any], following: Any) -> Any:
    """Return twice the speed."""
    return 2 * columns["speed"]


def test_two_robots_in_one_bag() -> None:
    bag = MemoryBag(
        {
            "/a/odom": ([0, 1, 2], {"speed": [0.0, 1.0, 2.0]}),
            "/b/odom": ([0, 1, 2], {"speed": [10.0, 11.0, 12.0]}),
            "/a/mode": ([0, 1, 2], {"data": [0.0, 0.0, 0.0]}),
            "/b/mode": ([0, 1, 2], {"data": [1.0, 1.0, 1.0]}),
        }
    )
    found = [
        read(
            bag,
            observation={"speed": {"field": f"/{name}/odom.speed"}},
            action={"field": f"/{name}/mode.data"},
        ).dataset
        for name in "ab"
    ]
    assert [data.observations.ravel().tolist() for data in found] == [[0, 1], [10, 11]]
    assert [data.actions.tolist() for data in found] == [[0, 0], [1, 1]]
