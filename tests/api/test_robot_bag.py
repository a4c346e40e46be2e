"""The example of a robot whose bag has no topics of this package."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

import mcaprl
from mcaprl.cli import run

EXAMPLE = Path(__file__).parents[2] / "examples" / "05_robot_bag"


@pytest.fixture(scope="module")
def native(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record drives; in one of them, the car stalls."""
    path = tmp_path_factory.mktemp("robot") / "native.mcap"
    mcaprl.record("lane", path, epsilon=0.1, episodes=3, seed=5)
    return path


def make(native: Path, form: str) -> Path:
    """Make a bag of the drives; start the example's script in the same way as Python does."""
    out = native.with_name(form if form == "ros2" else f"{form}.mcap")
    script = EXAMPLE / "make_bag.py"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(script), str(native), str(out), "--format", form])
        patch.syspath_prepend(EXAMPLE)
        runpy.run_path(str(script), run_name="__main__")
    return out


@pytest.mark.parametrize("form", ["ros2", "protobuf", "json"])
def test_the_bag_gives_the_transitions_of_the_native_log(native: Path, form: str) -> None:
    bag = make(native, form)
    recorded, read = mcaprl.open(native), mcaprl.open(bag, mapping=EXAMPLE / "robot.yaml")
    assert read.episode_lengths.tolist() == recorded.episode_lengths.tolist()
    differences = np.abs(read.frames - recorded.frames).max(axis=0)
    # The last odometry before a step is at most 20 ms old. In 20 ms, braking changes the speed by
    # at most 0.16 m/s. The observation is the speed divided by 30 m/s.
    speed = recorded.observation_names.index("speed")
    assert differences[speed] < 0.16 / 30
    assert np.delete(differences, speed).max() < 1e-6
    assert (read.actions == recorded.actions).all()
    assert read.action_meanings == recorded.action_meanings
    # The lane detector's distance along the route, up to 1,000 m, is rounded to float32.
    assert np.abs(read.rewards - recorded.rewards).max() < 1e-4
    assert (read.terminated == recorded.terminated).all()
    assert (read.truncated == recorded.truncated).all()
    assert [episode.reason for episode in read.episodes] == ["gap", "gap", "stall"]


def test_a_policy_that_learned_from_the_bag_drives_in_the_sim(
    native: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, runs = native.with_name("ros2"), tmp_path / "runs"
    bag = bag if bag.exists() else make(native, "ros2")
    mapping = ["--mapping", str(EXAMPLE / "robot.yaml")]
    train = ["train-offline", str(bag), *mapping, "--algo", "bc", "--updates", "20"]
    assert run([*train, "--out", str(runs)]) == 0
    assert run(["evaluate", str(runs), "--sim", "lane", "--episodes", "2"]) == 0
    assert "runs" in capsys.readouterr().out


def test_the_suggested_mapping_uses_frequent_topics(native: Path, tmp_path: Path) -> None:
    bag = native.with_name("ros2")
    bag = bag if bag.exists() else make(native, "ros2")
    (tmp_path / "suggested.yaml").write_text(mcaprl.suggest_mapping(bag))
    found = mcaprl.convert(mcaprl.open(bag, mapping=tmp_path / "suggested.yaml"), None)
    assert found.report is not None
    observed = found.dataset.observation_names
    # The messages contain the position of a joint by its name, and an empty array of velocities.
    assert "joint_states_position_steering" in observed
    assert "lane_data_10" in observed
    assert not any(name.startswith(("e_stop", "joint_states_velocity")) for name in observed)
    # The clock of the suggested mapping is not aligned with the messages of the lane detector.
    # Therefore, some steps are in the pauses between the drives.
    assert len(found.dataset) > 0.9 * len(mcaprl.open(native))
