"""Atari games and MiniGrid from the recording to the page, as users combine the functions."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation, TimeLimit

import mcaprl
from mcaprl.recorder.viewer.page.log_page import LogPage
from tests.conftest import need
from tests.recorder.viewer.test_browser_page import unpacked

STEPS, EPISODES = 12, 2


def pong() -> gym.Env[Any, Any]:
    import ale_py

    gym.register_envs(ale_py)
    game = gym.make("ALE/Pong-v5", frameskip=1, render_mode="rgb_array")
    return TimeLimit(FrameStackObservation(AtariPreprocessing(game, noop_max=3), 4), STEPS)


def view() -> gym.Env[Any, Any]:
    """Return MiniGrid with its own observations: a Dict of cells, a direction and a text."""
    name = "minigrid:MiniGrid-Empty-5x5-v0"
    return gym.make(name, render_mode="rgb_array", max_episode_steps=STEPS)


def grid() -> gym.Env[Any, Any]:
    """Return MiniGrid as an image of 16x16 cells."""
    from minigrid.wrappers import FullyObsWrapper, ImgObsWrapper

    name = "minigrid:MiniGrid-Empty-16x16-v0"
    game = gym.make(name, render_mode="rgb_array", max_episode_steps=STEPS)
    found: gym.Env[Any, Any] = ImgObsWrapper(FullyObsWrapper(game))
    return found


class Recorded(NamedTuple):
    make: Callable[[], gym.Env[Any, Any]]
    log: Path
    observations: list[Any]
    frames: list[Any]


@pytest.fixture(params=[pong, view, grid])
def game(request: pytest.FixtureRequest, log_path: Path) -> Recorded:
    for name in ("ale_py", "cv2", "minigrid", "av"):
        need(importlib.util.find_spec(name) is not None, f"{name} is not installed")
    seen: list[Any] = []
    frames: list[Any] = []
    with closing(mcaprl.RecordMcap(request.param(), log_path, camera="h264", seed=0)) as env:
        env.action_space.seed(0)
        for seed in range(EPISODES):
            observation, is_done = env.reset(seed=seed)[0], False
            while not is_done:
                seen.append(observation)
                frames.append(env.render())
                observation, _, terminated, truncated, _ = env.step(env.action_space.sample())
                is_done = terminated or truncated
            frames.append(env.render())
    return Recorded(request.param, log_path, seen, frames)


def batched(observations: list[Any]) -> Any:
    """Stack observations, or their parts that are not texts."""
    if not isinstance(observations[0], dict):
        return np.stack(observations)
    keys = [key for key, part in observations[0].items() if not isinstance(part, str)]
    return {key: np.stack([each[key] for each in observations]) for key in keys}


@pytest.mark.filterwarnings("ignore:.*updates of the target network")
def test_a_game_is_recorded_learned_evaluated_and_shown(game: Recorded, tmp_path: Path) -> None:
    data = mcaprl.open(game.log)
    assert (len(data), data.episode_lengths.tolist()) == (STEPS * EPISODES, [STEPS] * EPISODES)
    np.testing.assert_equal(data.observations, batched(game.observations))
    assert mcaprl.check(game.log).problems == ()
    if game.make is view:
        texts = {each["mission"] for each in game.observations}
        assert set(data.infos["observation.mission"]) == texts

    run = mcaprl.train(game.log, tmp_path / "run", algo="cql", updates=3, batch_size=8)
    policy = mcaprl.load_policy(run.folder)
    with closing(game.make()) as env:
        found = mcaprl.evaluate(run.folder, env, episodes=1, record=tmp_path / "policy.mcap")
    assert [score.policy for score in found.policies] == ["run", "random"]
    played = mcaprl.open(tmp_path / "policy.mcap")
    assert len(played) == STEPS
    assert played.actions.tolist() == policy.act(played.observations).tolist()

    mcaprl.annotate(game.log, tmp_path / "values.mcap", policy=str(run.folder))
    with mcaprl.open_bag(tmp_path / "values.mcap") as bag:
        values = np.stack(list(bag.read("/rl/values", ["q"]).columns["q"]))
    np.testing.assert_allclose(values, policy.q_values(data.observations), atol=1e-5)

    page = unpacked(LogPage(tmp_path / "values.mcap").episode(1))
    (rendered,) = [image for image in page["images"] if image["title"] == "rendered"]
    assert rendered["steps"].tolist() == list(range(STEPS + 1))
    colors = rendered["pixels"].mean(axis=(1, 2))
    expected = [frame.mean(axis=(0, 1)) for frame in game.frames[STEPS + 1 :]]
    np.testing.assert_allclose(colors, expected, atol=4)
    size = mcaprl.save_page(tmp_path / "values.mcap", tmp_path / "page.html", episode=1)
    assert size == (tmp_path / "page.html").stat().st_size
