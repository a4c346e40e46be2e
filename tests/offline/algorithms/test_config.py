"""Tests of settings: help texts, limits and the decay of the learning rate."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import numpy as np
import pytest

from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.offline.algorithms.config import (
    BCConfig,
    BCQConfig,
    CQLConfig,
    DQNConfig,
    IQLConfig,
    TrainingConfig,
)
from mcaprl.offline.algorithms.registry import ALGORITHMS, choose_algorithm
from mcaprl.settings import field_help


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_setting_has_one_line_of_help(name: str) -> None:
    config_type = ALGORITHMS[name].config_type
    lines = field_help(config_type)
    assert list(lines) == [field.name for field in dataclasses.fields(config_type)]
    assert all(line and "\n" not in line for line in lines.values())


def test_a_setting_of_one_algorithm_is_not_offered_by_another() -> None:
    assert "alpha" in field_help(CQLConfig)
    assert "alpha" not in field_help(DQNConfig)
    assert "gamma" not in field_help(BCConfig)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("updates", "9", "updates must be an integer, got 9"),
        ("updates", 9.0, "an integer"),
        ("updates", True, "an integer"),
        ("updates", math.inf, "an integer"),
        ("updates", 10**400, "an integer"),
        ("learning_rate", "fast", "learning_rate must be a number, got fast"),
        ("learning_rate", 10**400, "a number"),
        ("hidden", None, "hidden must be a list of integers"),
        ("hidden", ["a"], "a list of integers"),
        ("normalize", 1, "true or false"),
        ("encoder", [], "a text"),
    ],
)
def test_settings_have_the_type_of_their_field(name: str, value: Any, message: str) -> None:
    with pytest.raises(UsageError, match=re.escape(message)):
        CQLConfig(**{name: value})


def test_numbers_of_numpy_are_settings() -> None:
    given: dict[str, Any] = {"updates": np.int64(3), "alpha": np.float32(0.5), "gamma": 1}
    config = CQLConfig(**given)
    assert (config.updates, config.alpha, config.gamma) == (3, 0.5, 1)


def test_the_learning_rate_decays_linearly_to_its_final_fraction() -> None:
    config = TrainingConfig(updates=5, learning_rate=1.0, final_learning_rate_fraction=0.2)
    rates = [config.learning_rate_at(step) for step in range(5)]
    assert rates == pytest.approx([1.0, 0.8, 0.6, 0.4, 0.2])


def test_a_single_update_has_the_full_learning_rate() -> None:
    assert TrainingConfig(updates=1, learning_rate=0.5).learning_rate_at(0) == 0.5


def test_a_dueling_network_needs_a_hidden_layer() -> None:
    with pytest.raises(UsageError, match="hidden must be not empty if dueling"):
        DQNConfig(hidden=(), dueling=True)


@pytest.mark.parametrize(
    ("settings", "fraction"),
    [
        # After two syncs, values contain two rewards, 1 + .5. The total return is 2.
        ({"updates": 20, "target_interval": 10, "gamma": 0.5}, 0.75),
        ({"updates": 20, "target_interval": 10, "gamma": 0.5, "n_steps": 2}, 1 - 0.5**4),
        ({"updates": 20, "target_interval": 10, "gamma": 0.0}, 1.0),
        ({"updates": 20, "target_interval": 10, "gamma": 1.0}, 0.0),
    ],
)
def test_the_covered_fraction_of_the_horizon(settings: dict[str, Any], fraction: float) -> None:
    assert DQNConfig(**settings).horizon_fraction == pytest.approx(fraction)


def test_configs_cannot_be_changed() -> None:
    config: Any = CQLConfig()
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.alpha = 2.0


@pytest.mark.parametrize(
    ("config_type", "name", "value"),
    [
        (BCConfig, "updates", 0),
        (BCConfig, "batch_size", 0),
        (BCConfig, "learning_rate", 0.0),
        (BCConfig, "final_learning_rate_fraction", 1.5),
        (BCConfig, "hidden", (256, 0)),
        (BCConfig, "channels", (32,)),
        (BCConfig, "channels", (32, 64, 0)),
        (BCConfig, "log_interval", 0),
        (BCConfig, "weight_decay", -0.1),
        (BCConfig, "frame_stack", 0),
        (BCConfig, "frame_stack", 10**9),
        (BCConfig, "held_out", 1.0),
        (DQNConfig, "n_steps", 0),
        (DQNConfig, "n_quantiles", 0),
        (BCQConfig, "threshold", 1.1),
        (BCQConfig, "logits_penalty", -1.0),
        (IQLConfig, "expectile", 1.0),
        (IQLConfig, "beta", -1.0),
        (BCConfig, "checkpoint_interval", -1),
        (DQNConfig, "gamma", 1.01),
        (DQNConfig, "target_interval", 0),
        (CQLConfig, "alpha", -1.0),
        (CQLConfig, "target_gap", -0.1),
        (CQLConfig, "target_gap", float("inf")),
        (CQLConfig, "target_gap", float("nan")),
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(
    config_type: type[TrainingConfig], name: str, value: Any
) -> None:
    with pytest.raises(UsageError, match=rf"{name} must be .*got"):
        config_type(**{name: value})


@pytest.mark.parametrize("config_type", [BCConfig, DQNConfig, CQLConfig])
def test_nan_is_not_a_valid_setting(config_type: type[TrainingConfig]) -> None:
    with pytest.raises(UsageError, match="learning_rate"):
        config_type(learning_rate=float("nan"))


def test_an_algorithm_is_chosen_by_name_or_by_its_settings() -> None:
    assert choose_algorithm("cql")[1] == CQLConfig()
    assert choose_algorithm(CQLConfig(alpha=0.5))[1] == CQLConfig(alpha=0.5)
    assert choose_algorithm("cql")[0] is ALGORITHMS["cql"]


def test_an_unknown_algorithm_lists_the_known_ones() -> None:
    with pytest.raises(
        UnknownNameError, match=r"'cqll'.*known: bc, bcq, cql, double-dqn, dqn, iql"
    ):
        choose_algorithm("cqll")


def test_settings_of_no_algorithm_are_refused() -> None:
    with pytest.raises(UsageError, match="TrainingConfig"):
        choose_algorithm(TrainingConfig())
