"""Tests of reading SB3's model files without executing code in them."""

from __future__ import annotations

import base64
import io
import json
import os
import subprocess
import sys
import textwrap
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv

from mcaprl.api.policies import load_policies
from mcaprl.errors import PolicyError
from mcaprl.online import zip_file
from mcaprl.online.zip_file import OWN_NAME, describe_run, read_policy, save_policy
from mcaprl.runs import BEST_NAME, policy_files


def small(**kwargs: Any) -> dict[str, Any]:
    """Return new arguments of a small model; SB3 changes the dict `policy_kwargs`."""
    return {"device": "cpu", "policy_kwargs": {"net_arch": [8]}, **kwargs}


def dqn(**kwargs: Any) -> DQN:
    return DQN("MlpPolicy", gym.make("CartPole-v1"), buffer_size=10, **small(**kwargs))


def ours(path: Path, model: Any, env: gym.Env[Any, Any], algo: str = "dqn") -> Path:
    """Save a model in the same way as a training run."""
    spaces_ = (env.observation_space, env.action_space)
    save_policy(path, model, describe_run(algo, (8,), *spaces_, "CartPole-v1", {}))
    return path


def observations_of(space: spaces.Space[Any], count: int = 20) -> Any:
    space.seed(0)
    drawn = [space.sample() for _ in range(count)]
    if isinstance(space, spaces.Dict):
        return {key: np.stack([one[key] for one in drawn]) for key in space}
    return np.stack(drawn)


def rewrite(path: Path, out: Path, **members: bytes | None) -> Path:
    """Copy a zip file with other members.

    If the new content of a member is None, the member is omitted. In names, `_pth` means `.pth`.
    """
    changed = {
        name.replace("_pth", ".pth").replace("_json", ".json"): c for name, c in members.items()
    }
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            content = changed.pop(name, old.read(name))
            if content is not None:
                new.writestr(name, content)
    return out


@pytest.mark.parametrize("kind", [DQN, PPO, A2C])
@pytest.mark.parametrize("written_by", ["us", "sb3"])
def test_it_acts_as_sb3_does(tmp_path: Path, kind: Any, written_by: str) -> None:
    env = gym.make("CartPole-v1")
    model = kind("MlpPolicy", env, seed=1, **small())
    path = tmp_path / "model.zip"
    if written_by == "us":
        ours(path, model, env)
    else:
        model.save(path)
    policy = read_policy(path)
    observations = np.random.default_rng(0).normal(size=(30, 4)).astype(np.float32)
    expected = model.predict(observations, deterministic=True)[0]
    np.testing.assert_array_equal(policy.act(observations), expected)
    assert policy.name == "model"
    probabilities = policy.action_probabilities(observations)
    np.testing.assert_allclose(probabilities.sum(1), 1, rtol=1e-6)
    np.testing.assert_array_equal(probabilities.argmax(1), expected)
    if kind is DQN:
        np.testing.assert_array_equal(policy.q_values(observations).argmax(1), expected)
    else:
        with pytest.raises(PolicyError, match="no Q-values, only probabilities"):
            policy.q_values(observations)


@pytest.mark.parametrize("channel_first", [True, False])
def test_images_are_transposed_for_the_network(tmp_path: Path, channel_first: bool) -> None:
    env = FakeImageEnv(screen_height=36, screen_width=40, n_channels=1, channel_first=channel_first)
    model = DQN("CnnPolicy", env, buffer_size=10, **small())
    observations = observations_of(env.observation_space)
    expected = model.predict(observations, deterministic=True)[0]
    exact = read_policy(ours(tmp_path / "ours.zip", model, env))
    np.testing.assert_array_equal(exact.act(observations), expected)
    assert exact.observation_space == env.observation_space
    np.testing.assert_array_equal(exact.act(observations[::-1]), expected[::-1])
    model.save(tmp_path / "sb3.zip")
    np.testing.assert_array_equal(read_policy(tmp_path / "sb3.zip").act(observations), expected)


def test_dict_observations_are_supported(tmp_path: Path) -> None:
    env = SimpleMultiObsEnv(random_start=False)
    model = DQN("MultiInputPolicy", env, buffer_size=10, **small())
    policy = read_policy(ours(tmp_path / "model.zip", model, env))
    observations = observations_of(env.observation_space)
    expected = model.predict(observations, deterministic=True)[0]
    np.testing.assert_array_equal(policy.act(observations), expected)
    model.save(tmp_path / "sb3.zip")
    with pytest.raises(PolicyError, match="observation space is not a Box"):
        read_policy(tmp_path / "sb3.zip")


def test_networks_are_built_from_the_files_shapes(tmp_path: Path) -> None:
    kwargs = {"net_arch": {"pi": [8, 4], "vf": [6]}, "activation_fn": torch.nn.ReLU}
    model = PPO("MlpPolicy", gym.make("CartPole-v1"), device="cpu", policy_kwargs=kwargs)
    model.save(tmp_path / "model.zip")
    observations = np.random.default_rng(0).normal(size=(30, 4)).astype(np.float32)
    np.testing.assert_array_equal(
        read_policy(tmp_path / "model.zip").act(observations),
        model.predict(observations, deterministic=True)[0],
    )


def test_nothing_in_a_file_is_run(tmp_path: Path) -> None:
    """All pickles of the file are replaced by a pickle that would make a folder."""
    path = ours(tmp_path / "good.zip", dqn(), gym.make("CartPole-v1"))
    ran = tmp_path / "ran"

    class Bomb:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(ran),)

    pickled = base64.b64encode(cloudpickle.dumps(Bomb())).decode()
    with zipfile.ZipFile(path) as archive:
        data = json.loads(archive.read("data"))
    bombed = {
        key: {**value, ":serialized:": pickled} if isinstance(value, dict) else value
        for key, value in data.items()
    }
    text = json.dumps(bombed).encode()
    read_policy(rewrite(path, tmp_path / "data.zip", data=text))
    read_policy(rewrite(path, tmp_path / "plain.zip", data=text, mcaprl_json=None))
    weights = io.BytesIO()
    torch.save({"q_net.q_net.0.weight": Bomb()}, weights)
    with pytest.raises(PolicyError, match="not plain tensors"):
        read_policy(rewrite(path, tmp_path / "weights.zip", policy_pth=weights.getvalue()))
    assert not ran.exists()


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"policy_pth": None}, "is not a model of Stable-Baselines3: .*policy.pth"),
        ({"data": None}, "is not a model of Stable-Baselines3: .*data"),
        ({"data": b"{"}, "cannot read the model"),
        ({"data": b"[]"}, "its parts have wrong types"),
        ({"policy_pth": b"PK"}, "cannot read the model|not plain tensors"),
        ({"mcaprl_json": b'{"format_version": 9}'}, "format_version 9 is not supported"),
        ({"mcaprl_json": b'{"format_version": 1}'}, "cannot load the policy .* has no algo"),
        ({"mcaprl_json": None, "data": b"{}"}, "observation space is not a Box"),
    ],
)
def test_broken_files_are_one_line_errors(
    tmp_path: Path, members: dict[str, bytes | None], message: str
) -> None:
    path = ours(tmp_path / "good.zip", dqn(), gym.make("CartPole-v1"))
    broken = rewrite(path, tmp_path / "broken.zip", **members)
    with pytest.raises(PolicyError, match=message) as caught:
        read_policy(broken)
    assert "broken.zip" in str(caught.value)


def test_weights_of_another_network_are_refused(tmp_path: Path) -> None:
    path = ours(tmp_path / "good.zip", dqn(), gym.make("CartPole-v1"))
    with zipfile.ZipFile(path) as archive:
        own = json.loads(archive.read(OWN_NAME))
    text = json.dumps({**own, "net_arch": [9]}).encode()
    with pytest.raises(PolicyError, match="size mismatch"):
        read_policy(rewrite(path, tmp_path / "other.zip", mcaprl_json=text))


def test_files_that_are_not_zip_are_refused(tmp_path: Path) -> None:
    (tmp_path / "model.zip").write_bytes(b"no zip")
    with pytest.raises(PolicyError, match="cannot read the model"):
        read_policy(tmp_path / "model.zip")
    with pytest.raises(PolicyError, match="does not exist"):
        read_policy(tmp_path / "none.zip")


def test_other_algorithms_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zip_file, "_FIRST_WEIGHTS", {"q-network": "q_net.q_net."})
    SAC("MlpPolicy", gym.make("Pendulum-v1"), buffer_size=10, **small()).save(tmp_path / "sac.zip")
    with pytest.raises(PolicyError, match="not DQN, SAC, TQC, TD3, PPO or A2C"):
        read_policy(tmp_path / "sac.zip")


def test_unknown_networks_are_refused(tmp_path: Path) -> None:
    kwargs = {"net_arch": [8], "features_extractor_kwargs": {}}
    dqn(policy_kwargs=kwargs).save(tmp_path / "model.zip")
    with pytest.raises(PolicyError, match="policy_kwargs features_extractor_kwargs"):
        read_policy(tmp_path / "model.zip")


def test_observations_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    policy = read_policy(ours(tmp_path / "model.zip", dqn(), gym.make("CartPole-v1")))
    with pytest.raises(PolicyError, match=r"expects observations \(B, 4\), got \(1, 5\)"):
        policy.act(np.zeros((1, 5), dtype=np.float32))


def test_a_runs_seeds_are_in_order(tmp_path: Path) -> None:
    for seed in (10, 2):
        (tmp_path / f"seed-{seed}").mkdir()
        ours(tmp_path / f"seed-{seed}" / BEST_NAME, dqn(), gym.make("CartPole-v1"))
    names = [policy.name.split("/")[1] for policy in load_policies(tmp_path)]
    assert names == ["seed-2", "seed-10"]
    assert policy_files(tmp_path / "seed-2") == [tmp_path / "seed-2" / BEST_NAME]


def test_sb3_loads_the_model_without_this_package(tmp_path: Path) -> None:
    env = gym.make("CartPole-v1")
    model = dqn(seed=4)
    path = ours(tmp_path / "model.zip", model, env)
    code = f"""
        import sys
        sys.modules["mcaprl"] = None
        from stable_baselines3 import DQN
        model = DQN.load({str(path)!r})
        print(int(model.predict([0.1, 0.2, 0.3, 0.4], deterministic=True)[0]))
    """
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        check=True,
    )
    action = model.predict(np.array([0.1, 0.2, 0.3, 0.4]), deterministic=True)[0]
    assert int(done.stdout) == int(action)


def edited(path: Path, out: Path, name: str, **changes: Any) -> Path:
    """Copy a model file, and change values in one of its JSON members."""
    with zipfile.ZipFile(path) as archive:
        content = {**json.loads(archive.read(name)), **changes}
    return rewrite(path, out, **{name.replace(".", "_"): json.dumps(content).encode()})


LARGE_BOX = {"type": "Box", "low": 0, "high": 1, "shape": [3 * 10**8], "dtype": "float32"}


@pytest.mark.parametrize(
    "changes",
    [
        {"frame_stack": 10**9},
        {"observation_space": LARGE_BOX},
        {"observation_space": {**LARGE_BOX, "shape": [2**24]}},
        {"action_space": {"type": "Discrete", "n": 10**12, "start": 0}},
        {"net_arch": [10**9]},
        {"net_arch": [8, 10**5, 10**5]},
        {"net_arch": ["8"]},
        {"net_arch": {"pi": [10**9]}},
    ],
)
def test_sizes_are_refused_before_memory_is_taken(tmp_path: Path, changes: Any) -> None:
    model = dqn()
    path = ours(tmp_path / "ours.zip", model, gym.make("CartPole-v1"))
    tracemalloc.start()
    try:
        with pytest.raises(PolicyError) as error:
            read_policy(edited(path, tmp_path / "large.zip", OWN_NAME, **changes))
        # 400 MB is more than the bounds of the largest accepted space need.
        assert tracemalloc.get_traced_memory()[1] < 400e6
    finally:
        tracemalloc.stop()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("role", "name", "value"),
    [("observation_space", "_shape", [3 * 10**8]), ("action_space", "n", 10**12)],
)
def test_sizes_in_files_of_sb3_are_refused(
    tmp_path: Path, role: str, name: str, value: Any
) -> None:
    dqn().save(tmp_path / "sb3.zip")
    with zipfile.ZipFile(tmp_path / "sb3.zip") as archive:
        space = {**json.loads(archive.read("data"))[role], name: value}
    with pytest.raises(PolicyError, match="too large"):
        read_policy(edited(tmp_path / "sb3.zip", tmp_path / "large.zip", "data", **{role: space}))


@pytest.mark.parametrize("name", ["data", "policy_pth"])
def test_compressed_blanks_are_not_unpacked(tmp_path: Path, name: str) -> None:
    dqn().save(tmp_path / "sb3.zip")
    path = rewrite(tmp_path / "sb3.zip", tmp_path / "large.zip", **{name: None})
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name.replace("_", "."), b" " * 10**8)
    tracemalloc.start()
    try:
        with pytest.raises(PolicyError, match="100000000 bytes, more than the"):
            read_policy(path)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


def test_weights_compressed_within_are_not_unpacked(tmp_path: Path) -> None:
    dqn().save(tmp_path / "sb3.zip")
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data/0", bytes(10**8))
    path = rewrite(tmp_path / "sb3.zip", tmp_path / "large.zip", policy_pth=inner.getvalue())
    with pytest.raises(PolicyError, match="more than the"):
        read_policy(path)


def test_deep_json_is_refused(tmp_path: Path) -> None:
    dqn().save(tmp_path / "sb3.zip")
    deep = b"[" * 100_000 + b"]" * 100_000
    with pytest.raises(PolicyError, match="nested"):
        read_policy(rewrite(tmp_path / "sb3.zip", tmp_path / "deep.zip", data=deep))
