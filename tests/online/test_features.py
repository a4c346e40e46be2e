"""Tests of this package's networks in SB3's policies: inputs, normalization, files, settings."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.torch_layers import NatureCNN

import mcaprl
from mcaprl.architecture import Architecture
from mcaprl.errors import PolicyError, UsageError
from mcaprl.networks import Convolutions, ImageInput
from mcaprl.online.agent import CENTERING_STEPS
from mcaprl.online.config import DoubleDQNConfig, PPOConfig
from mcaprl.online.features import (
    NetworkDQNPolicy,
    NetworkFeatures,
    normalize_images,
    policy_arguments,
)
from mcaprl.online.learning import LearningAgent
from mcaprl.online.sb3 import ModelAgent
from mcaprl.online.task import Task
from mcaprl.online.train import make_agent
from mcaprl.online.zip_file import describe_run, read_policy, save_policy
from mcaprl.sims.evaluation.evaluate import Scale

SHORT: dict[str, Any] = {
    "steps": 100,
    "hidden": (8, 8),
    "envs": 4,
    "learning_starts": 40,
    "eval_interval": 100,
    "eval_episodes": 2,
    "final_episodes": 2,
}


class Camera(gym.Env[Any, int]):
    """Environment that returns a depth image and, if requested, a vector."""

    def __init__(self, shape: tuple[int, ...] = (84, 84, 1), vector: bool = False) -> None:
        self.action_space: Any = spaces.Discrete(3)
        image = spaces.Box(0, 255, shape, np.uint8)
        motion = spaces.Box(-1.0, 1.0, (3,))
        both = spaces.Dict({"depth": image, "motion": motion})
        self.observation_space: Any = both if vector else image

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        super().reset(**kwargs)
        return self.observation_space.sample(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 0.0, False, False, {}


def samples(space: spaces.Space[Any], count: int = 9) -> Any:
    space.seed(0)
    drawn = [space.sample() for _ in range(count)]
    if isinstance(space, spaces.Dict):
        return {key: np.stack([one[key] for one in drawn]) for key in space}
    return np.stack(drawn)


def model_of(env: gym.Env[Any, Any], architecture: Architecture) -> DQN:
    kwargs = policy_arguments(architecture)
    return DQN(NetworkDQNPolicy, env, buffer_size=10, policy_kwargs=kwargs, device="cpu")


@pytest.mark.parametrize("vector", [False, True])
@pytest.mark.parametrize(
    "architecture",
    [
        Architecture((8, 8), encoder="compact"),
        Architecture((8, 8), (4, 6), layer_norm=True, dueling=True, encoder="compact"),
        Architecture((), encoder="nature"),
    ],
)
def test_files_contain_the_whole_network(
    tmp_path: Path, architecture: Architecture, vector: bool
) -> None:
    env = Camera(vector=vector)
    model = model_of(env, architecture)
    observations = samples(env.observation_space)
    image = observations["depth"] if vector else observations
    normalize_images(model.policy, [ImageInput((84, 84, 1)).normalized_to(image)], 1)
    path = tmp_path / "model.zip"
    spaces_ = (env.observation_space, env.action_space)
    save_policy(
        path, model, describe_run("dqn", (8, 8), *spaces_, "Camera-v0", {}, 1, architecture)
    )
    with torch.no_grad():
        expected = model.q_net(model.policy.obs_to_tensor(observations)[0]).numpy()
        plain = DQN.load(path)
        again = plain.q_net(plain.policy.obs_to_tensor(observations)[0]).numpy()
    np.testing.assert_array_equal(again, expected)
    np.testing.assert_allclose(
        read_policy(path).q_values(observations), expected, rtol=1e-5, atol=1e-6
    )


def test_an_actor_critic_has_the_same_layers(tmp_path: Path) -> None:
    env = Camera()
    architecture = Architecture((8,), encoder="compact")
    arguments = policy_arguments(architecture)
    model = PPO("CnnPolicy", env, n_steps=4, batch_size=4, policy_kwargs=arguments, device="cpu")
    path = tmp_path / "model.zip"
    spaces_ = (env.observation_space, env.action_space)
    save_policy(path, model, describe_run("ppo", (8,), *spaces_, "Camera-v0", {}, 1, architecture))
    observations = samples(env.observation_space)
    np.testing.assert_array_equal(
        read_policy(path).act(observations), model.predict(observations, deterministic=True)[0]
    )


def test_a_file_with_too_few_weights_is_refused(tmp_path: Path) -> None:
    env = Camera()
    architecture = Architecture((8,), encoder="compact")
    model = model_of(env, architecture)
    spaces_ = (env.observation_space, env.action_space)
    for wrong in (Architecture((10**9,), encoder="compact"), Architecture((8,), encoder="none")):
        description = describe_run("dqn", (8,), *spaces_, "Camera-v0", {}, 1, wrong)
        save_policy(tmp_path / "model.zip", model, description)
        with pytest.raises(PolicyError, match=r"more than the|encoder 'none' is not supported"):
            read_policy(tmp_path / "model.zip")


def test_images_have_mean_0_and_deviation_1_after_normalization() -> None:
    """The pixels of the two images differ by 20, so their standard deviation is 10."""
    env = Camera()
    model = model_of(env, Architecture((8,), encoder="compact"))
    images = np.stack([np.full((84, 84, 1), value, np.uint8) for value in (100, 120)])
    normalize_images(model.policy, [ImageInput((84, 84, 1)).normalized_to(images)], 1)
    seen: list[torch.Tensor] = []
    extractor = model.q_net.features_extractor
    assert isinstance(extractor, NetworkFeatures)
    (convolutions,) = extractor.convolutions
    convolutions.layers.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    with torch.no_grad():
        model.q_net(model.policy.obs_to_tensor(images)[0])
    assert seen[0].shape == (2, 1, 42, 42)
    np.testing.assert_allclose(seen[0][0], -1.0, atol=1e-5)
    np.testing.assert_allclose(seen[0][1], 1.0, atol=1e-5)


def test_averaged_images_have_the_same_values() -> None:
    """Images are averaged before they are stored for training, or by the network when it acts."""
    env = Camera(vector=True)
    model = model_of(env, Architecture((8, 8), encoder="compact"))
    blocks = np.random.default_rng(0).integers(0, 256, (5, 1, 42, 42), dtype=np.uint8)
    vector = torch.rand(5, 3)
    with torch.no_grad():
        values = [
            model.q_net({"depth": torch.from_numpy(images), "motion": vector})
            for images in (blocks, blocks.repeat(2, 2).repeat(2, 3))
        ]
    torch.testing.assert_close(values[0], values[1])


def agent(folder: Path, observation: str, algo: str = "double-dqn", **settings: Any) -> Any:
    task = Task.for_sim("lane", algo, {"observation": observation}, **{**SHORT, **settings})
    return make_agent(task, "mcaprl/LaneKeeping-v0", folder, 0, Scale(0.0, 1.0))


def networks_of(begun: Any) -> list[Any]:
    """Return the network that learns, and its target network."""
    if isinstance(begun, ModelAgent):
        model: Any = begun.model
        return [model.q_net, model.q_net_target]
    return [model.networks[0] for model in begun.agents.learner.all_models().values()]


@pytest.mark.parametrize("algo", ["dqn", "double-dqn"])
def test_an_agent_centers_the_images_of_random_steps(tmp_path: Path, algo: str) -> None:
    assert CENTERING_STEPS >= 1_000
    with closing(agent(tmp_path, "depth", algo, frame_stack=2)) as begun:
        found = [
            part
            for network in networks_of(begun)
            for part in network.modules()
            if isinstance(part, Convolutions)
        ]
        convolutions, target = found
        assert convolutions.shift.shape == (2, 42, 42)
        mean = convolutions.shift
        assert torch.equal(mean[0], mean[1]), "both frames of a stack have the same mean"
        # The sky above the street is 255, and the ground before the car is near.
        assert mean[0, 0, 20] > 200 > 100 > mean[0, -1, 20]
        assert 20 < convolutions.scale < 120
        assert torch.equal(target.shift, convolutions.shift)


def test_sb3s_network_is_used_if_it_is_asked_for(tmp_path: Path) -> None:
    plain = {"encoder": "nature", "center_images": False, "dueling": False, "layer_norm": False}
    with closing(agent(tmp_path, "depth", "dqn", **plain)) as begun:
        assert isinstance(begun.model.q_net.features_extractor, NatureCNN)


def test_settings_that_sb3_lacks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="dqn of Stable-Baselines3 has no image_shift"):
        agent(tmp_path, "depth", "dqn", image_shift=1)
    with pytest.raises(UsageError, match="has no n_steps for Dict observations: omit it"):
        agent(tmp_path, "dashboard", "dqn", n_steps=3)
    with pytest.raises(UsageError, match="image_shift is for images"):
        agent(tmp_path, "state", image_shift=1)


@pytest.mark.parametrize(
    ("channels", "settings", "encoder"),
    [
        ([1], {}, "compact"),
        ([1, 1], {}, "compact"),
        ([3], {}, "nature"),
        ([1, 3], {}, "nature"),
        ([1], {"channels": (8, 8, 8)}, "nature"),
        ([3], {"channels": (8, 8)}, "compact"),
        ([1], {"encoder": "nature"}, "nature"),
    ],
)
def test_the_encoder_fits_the_images(
    channels: list[int], settings: dict[str, Any], encoder: str
) -> None:
    assert DoubleDQNConfig(**settings).architecture_for(channels).encoder == encoder


class Grid(Camera):
    """Random cells; episodes end at random."""

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        seen, _, _, _, info = super().step(action)
        return seen, float(action), self.np_random.random() < 0.2, False, info


@pytest.mark.parametrize("shape", [(10, 10, 4), (4, 10, 12), (7, 7, 3), (3, 40, 36)])
@pytest.mark.parametrize("algo", ["double-dqn", "ppo"])
def test_agents_learn_from_small_images_and_channels_first(
    tmp_path: Path, shape: tuple[int, ...], algo: str
) -> None:
    name = f"Grid{'-'.join(map(str, shape))}-v0"
    settings = {key: value for key, value in SHORT.items() if key != "learning_starts"}
    gym.register(name, lambda **options: Grid(shape))
    try:
        mcaprl.train_online(name, tmp_path / "run", algo=algo, frame_stack=2, **settings)
    finally:
        gym.registry.pop(name)
    policy = mcaprl.load_policy(tmp_path / "run" / "seed-0")
    stacks = np.random.default_rng(0).integers(256, size=(5, *shape), dtype=np.uint8)
    assert policy.act(stacks).shape == (5,)


def test_settings_of_networks_are_validated() -> None:
    with pytest.raises(UsageError, match="encoder must be one of auto, nature, compact"):
        PPOConfig(encoder="large")
    with pytest.raises(UsageError, match="channels must be 2 numbers"):
        PPOConfig(encoder="compact", channels=(1, 2, 3))
    with pytest.raises(UsageError, match="hidden must be not empty if dueling"):
        DoubleDQNConfig(hidden=(), dueling=True)


def test_dueling_networks_learn_from_vectors(tmp_path: Path) -> None:
    settings = {**SHORT, "dueling": True, "layer_norm": True, "eval_interval": 50}
    task = Task.for_sim("lane", None, {}, **settings)
    with closing(make_agent(task, "Lane-v0", tmp_path, 0, Scale(0.0, 1.0))) as begun:
        assert isinstance(begun, LearningAgent)
        weights = begun.agents.learner.models["q"].weights
        before = weights.clone()
        begun.learn(lambda _: None)
        assert not torch.equal(weights, before)


def test_parts_of_a_dict_reach_the_network_in_the_order_of_the_space() -> None:
    env = SimpleMultiObsEnv(random_start=False)
    model = model_of(env, Architecture((8,), encoder="compact"))
    observations = samples(env.observation_space)
    with torch.no_grad():
        values = model.q_net(model.policy.obs_to_tensor(observations)[0]).numpy()
        changed = {**observations, "vec": observations["vec"] + 1}
        others = model.q_net(model.policy.obs_to_tensor(changed)[0]).numpy()
    assert not np.allclose(values, others)
