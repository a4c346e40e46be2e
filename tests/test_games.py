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
from gymnasium import spaces
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


class Pocket(gym.Env[Any, Any]):
    """Game whose observations are a Tuple: a position, a phase and an image of it."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = spaces.Tuple(
        (spaces.Box(0, 1, (2,)), spaces.Discrete(3), spaces.Box(0, 255, (12, 12, 3), np.uint8))
    )
    action_space = spaces.Discrete(3)

    def __init__(self) -> None:
        self.render_mode = "rgb_array"

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self._step, self._position = 0, self.np_random.random(2, np.float32)
        return self._observe(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self._step += 1
        self._position = 0.9 * self._position + np.float32(0.05 * action)
        return self._observe(), float(action == self._step % 3), False, False, {}

    def render(self) -> Any:
        image = np.full((12, 12, 3), 20, np.uint8)
        image[self._step % 12] = 200
        return image

    def _observe(self) -> tuple[Any, ...]:
        return self._position, np.int64(self._step % 3), self.render()


def pocket() -> gym.Env[Any, Any]:
    return TimeLimit(Pocket(), STEPS)


class Recorded(NamedTuple):
    make: Callable[[], gym.Env[Any, Any]]
    log: Path
    observations: list[Any]
    frames: list[Any]


@pytest.fixture(params=[pong, view, grid, pocket])
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
    """Stack observations, or their parts that are not texts; a Tuple is recorded as a Dict."""
    if isinstance(observations[0], tuple):
        return {
            str(number): np.stack(part)
            for number, part in enumerate(zip(*observations, strict=True))
        }
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


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_games_in_parallel_are_recorded_as_they_were_seen(log_path: Path, mode: str) -> None:
    need(importlib.util.find_spec("ale_py") is not None, "ale_py is not installed")
    from ale_py.vector_env import AtariVectorEnv

    with pytest.raises(mcaprl.UsageError, match=r"returns those of 2 of its 4 .* batch_size=4"):
        mcaprl.RecordVecMcap(AtariVectorEnv("pong", 4, batch_size=2), log_path)
    # Episodes end after 40 frames, which are 10 steps.
    games = AtariVectorEnv("pong", 2, autoreset_mode=mode, max_num_frames_per_episode=40)
    steps: list[tuple[Any, Any, Any]] = []
    with closing(mcaprl.RecordVecMcap(games, log_path)) as env:
        env.action_space.seed(0)
        observations, _ = env.reset(seed=0)
        for _ in range(25):
            actions = env.action_space.sample()
            before, (observations, rewards, *_) = observations, env.step(actions)
            steps.append((before, actions, rewards))
    data = mcaprl.open(log_path)
    assert mcaprl.check(log_path).problems == ()
    # In the mode NextStep, one step after each episode resets the environment.
    pause = mode == "NextStep"
    starts = [0, 10 + pause, 20 + 2 * pause]
    lengths = [10, 10, 25 - starts[2]]
    assert data.episode_lengths.tolist() == [length for length in lengths for _ in range(2)]
    for number, episode in enumerate(data.episodes):
        game, first = number % 2, starts[number // 2]
        own = steps[first : first + episode.length]
        np.testing.assert_equal(episode.observations, [before[game] for before, _, _ in own])
        assert episode.actions.tolist() == [actions[game] for _, actions, _ in own]
        assert episode.rewards.tolist() == [rewards[game] for _, _, rewards in own]
