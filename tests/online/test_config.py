"""Tests of the settings of online algorithms: help, limits, and the arguments of SB3."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.online.config import (
    BOX_ALGO_SETTINGS,
    BOX_SETTINGS,
    CONFIGS,
    IMAGE_SETTINGS,
    SIM_SETTINGS,
    A2CConfig,
    DoubleDQNConfig,
    DQNConfig,
    OnlineConfig,
    PPOConfig,
    SACConfig,
    TD3Config,
    settings_for,
)
from mcaprl.online.task import Task, find_config
from mcaprl.settings import field_help
from mcaprl.sims import SIMS


@pytest.mark.parametrize("name", CONFIGS)
def test_every_setting_has_one_line_of_help(name: str) -> None:
    config_type = CONFIGS[name]
    lines = field_help(config_type)
    assert list(lines) == [field.name for field in dataclasses.fields(config_type)]
    assert all(line and "\n" not in line for line in lines.values())


@pytest.mark.parametrize(
    ("envs", "steps_per_update", "train_freq", "gradient_steps"),
    [(1, 4, 4, 1), (8, 4, 1, 2), (4, 4, 1, 1), (2, 8, 4, 1), (16, 1, 1, 16)],
)
def test_steps_per_update_are_steps_of_all_environments(
    envs: int, steps_per_update: int, train_freq: int, gradient_steps: int
) -> None:
    arguments = DQNConfig(envs=envs, steps_per_update=steps_per_update).arguments()
    assert (arguments["train_freq"], arguments["gradient_steps"]) == (train_freq, gradient_steps)


def test_a_buffer_is_not_larger_than_the_run_fills_it() -> None:
    assert DQNConfig(steps=1_000, envs=8).arguments()["buffer_size"] == 1_008
    assert DQNConfig(steps=1_000, buffer_size=500).arguments()["buffer_size"] == 500


def test_a_rollout_is_shared_by_the_environments() -> None:
    assert PPOConfig(envs=8, rollout_steps=2_048).arguments()["n_steps"] == 256
    assert A2CConfig(envs=8, rollout_steps=40).arguments()["n_steps"] == 5


@pytest.mark.parametrize(
    ("config_type", "name", "value"),
    [
        (DQNConfig, "steps", 0),
        (DQNConfig, "envs", 0),
        (DQNConfig, "learning_rate", 0.0),
        (DQNConfig, "gamma", 1.1),
        (DQNConfig, "hidden", (0,)),
        (DQNConfig, "max_grad_norm", -1.0),
        (DQNConfig, "eval_interval", 0),
        (DQNConfig, "n_steps", 0),
        (DQNConfig, "buffer_size", 7),
        (DQNConfig, "learning_starts", -1),
        (DQNConfig, "exploration_fraction", 2.0),
        (DQNConfig, "exploration_final_eps", -0.1),
        (DQNConfig, "steps_per_update", 3),
        (SACConfig, "polyak", 0.0),
        (SACConfig, "data_fraction", 1.5),
        (SACConfig, "temperature", 0.0),
        (SACConfig, "target_entropy", 1.0),
        (SACConfig, "smoothness", -0.1),
        (SACConfig, "actor_starts", -1),
        (SACConfig, "actor_rate", 0.0),
        (TD3Config, "anchor", -0.1),
        (TD3Config, "exploration_noise", 0.0),
        (TD3Config, "policy_interval", 0),
        (PPOConfig, "max_grad_norm", 0.0),
        (PPOConfig, "rollout_steps", 2_047),
        (PPOConfig, "epochs", 0),
        (PPOConfig, "batch_size", 63),
        (A2CConfig, "rollout_steps", 4),
    ],
)
def test_invalid_settings_are_refused(
    config_type: type[OnlineConfig], name: str, value: Any
) -> None:
    with pytest.raises(UsageError, match=f"^{name} must be"):
        config_type(**{name: value})


def test_an_unknown_algorithm_lists_the_known_ones() -> None:
    with pytest.raises(UnknownNameError, match="did you mean dqn"):
        find_config("dqm")


@pytest.mark.parametrize("sim", SIMS)
def test_every_sim_has_settings_that_are_fields(sim: str) -> None:
    settings = settings_for("double-dqn", sim, {})
    assert settings == SIM_SETTINGS[sim]
    assert settings == settings_for("double-dqn", SIMS[sim], {"rules": "default"})
    assert DoubleDQNConfig(**settings).steps == settings["steps"]


@pytest.mark.parametrize("sim", SIMS)
def test_every_sim_has_settings_for_continuous_actions(sim: str) -> None:
    settings = settings_for("sac", sim, {"actions": "continuous"})
    assert settings == BOX_SETTINGS[sim] | BOX_ALGO_SETTINGS["sac"][sim]
    assert SACConfig(**settings).steps == settings["steps"]
    spec = SIMS.find(SIMS[sim])
    assert spec is not None
    continuous_id = spec.continuous_id
    assert continuous_id is not None
    settings = settings_for("td3", continuous_id, {})
    assert settings == BOX_SETTINGS[sim] | BOX_ALGO_SETTINGS["td3"][sim]
    assert TD3Config(**settings).steps == settings["steps"]


@pytest.mark.parametrize(("sim", "observation"), IMAGE_SETTINGS)
def test_images_have_settings_that_are_fields(sim: str, observation: str) -> None:
    settings = settings_for("double-dqn", sim, {"observation": observation})
    assert settings == IMAGE_SETTINGS[sim, observation]
    assert DoubleDQNConfig(**settings).center_images


@pytest.mark.parametrize(
    ("algo", "sim", "sim_options"),
    [
        ("dqn", "CartPole-v1", {}),
        ("dqn", "lane", {"observation": "depth", "rules": "classic"}),
        ("dqn", "racer", {"rules": "classic"}),
        ("ppo", "lane", {}),
        ("td3", "Pendulum-v1", {}),
    ],
)
def test_other_tasks_have_sb3s_settings(algo: str, sim: str, sim_options: dict[str, Any]) -> None:
    assert settings_for(algo, sim, sim_options) == {}


def test_the_users_settings_take_precedence() -> None:
    config = Task.for_sim("racer", n_steps=5).config
    assert isinstance(config, DoubleDQNConfig)
    assert (config.n_steps, config.gamma) == (5, 0.98)
