"""Tests of making a sim by its name."""

from __future__ import annotations

from typing import Any

import pytest

from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.sims import SIMS, make_sim


@pytest.mark.parametrize(
    "name", ["lane", "mcaprl/LaneKeeping-v0", "mcaprl.sims:mcaprl/LaneKeeping-v0"]
)
def test_short_names_and_ids_make_the_same_sim(name: str) -> None:
    env = make_sim(name)
    assert env.spec is not None
    assert env.spec.id == SIMS["lane"]
    assert env.spec.max_episode_steps == 400


def test_any_gymnasium_environment_can_be_made() -> None:
    env = make_sim("CartPole-v1", max_episode_steps=7)
    assert env.spec is not None
    assert env.spec.max_episode_steps == 7


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("lan", "unknown sim 'lan': did you mean lane"),
        ("CartPol-v1", "did you mean CartPole-v1"),
        ("mcaprl/LaneKeeping-v7", "did you mean mcaprl/LaneKeeping-v0"),
    ],
)
def test_an_unknown_name_suggests_the_nearest(name: str, words: str) -> None:
    with pytest.raises(UnknownNameError, match=words):
        make_sim(name)


@pytest.mark.parametrize(
    ("name", "kwargs", "words"),
    [
        ("lane", {"wheels": 3}, "sim 'lane' has no argument wheels: omit it$"),
        ("CartPole-v1", {"rules": "classic"}, "sim 'CartPole-v1' has no argument rules: omit it$"),
        ("no_such_module:Thing-v0", {}, "cannot make sim 'no_such_module:Thing-v0'"),
        ("one:two:three", {}, "cannot make sim 'one:two:three'"),
    ],
)
def test_a_sims_refusal_is_one_line(name: str, kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(UsageError, match=words) as caught:
        make_sim(name, **kwargs)
    assert "\n" not in str(caught.value)
