"""The example of a robot whose bag has no topics of this package."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.cli import run
from tests.drive.test_driver import Fixed, compared
from tests.support.layouts import Topics, check_panels

EXAMPLE = Path(__file__).parents[2] / "examples" / "05_robot_bag"


@pytest.fixture(scope="module")
def buttons(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record drives of the car with buttons; in one of them, the car stalls."""
    path = tmp_path_factory.mktemp("buttons") / "native.mcap"
    mcaprl.record("lane", path, epsilon=0.1, episodes=3, seed=5)
    return path


@pytest.fixture(scope="module")
def native(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record drives with a pedal and a steering wheel; noise ends some of them."""
    path = tmp_path_factory.mktemp("robot") / "native.mcap"
    options = {"actions": "continuous"}
    mcaprl.record("lane", path, sim_options=options, noise=0.1, episodes=3, seed=5)
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


def assert_same_drives(recorded: mcaprl.Dataset, read: mcaprl.Dataset) -> None:
    """Check that a bag has the transitions of the native log."""
    assert read.episode_lengths.tolist() == recorded.episode_lengths.tolist()
    differences = np.abs(read.frames - recorded.frames).max(axis=0)
    # The last odometry before a step is at most 20 ms old. In 20 ms, braking changes the speed by
    # at most 0.16 m/s. The observation is the speed divided by 30 m/s.
    speed = recorded.observation_names.index("speed")
    assert differences[speed] < 0.16 / 30
    assert np.delete(differences, speed).max() < 1e-6
    np.testing.assert_array_equal(read.actions, recorded.actions)
    assert read.action_space == recorded.action_space
    assert read.observation_names == recorded.observation_names
    # The lane detector's distance along the route, up to 1,000 m, is rounded to float32.
    assert np.abs(read.rewards - recorded.rewards).max() < 1e-4
    assert (read.terminated == recorded.terminated).all()
    assert (read.truncated == recorded.truncated).all()


def assert_driver_sees(bag: Path, data: mcaprl.Dataset) -> None:
    """Check that a driver builds all observations of a bag message by message."""
    tree = data.robot
    has_buttons = isinstance(data.action_space, spaces.Discrete)
    tree["mapping"]["drive"]["stop"] = "brake" if has_buttons else [-1, 0]
    driver = mcaprl.Driver(Fixed(data), mapping=tree)
    assert compared(driver, bag, data) == len(data._transitions.log_time_ns)


@pytest.mark.parametrize("form", ["ros2", "protobuf", "json"])
def test_the_bag_gives_the_transitions_of_the_native_log(native: Path, form: str) -> None:
    bag = make(native, form)
    read = mcaprl.open(bag, mapping=EXAMPLE / "robot.yaml")
    assert_driver_sees(bag, read)
    assert_same_drives(mcaprl.open(native), read)
    # Viewers show the camera, the odometry, and the quantities in their units.
    log = bag.with_name(f"{form}-log.mcap")
    mcaprl.convert(read, log)
    assert not mcaprl.check(log).problems
    panels = mcaprl.layout(log)["configById"]
    shown = {"Gauge!speed", "Plot!offsets", "Plot!angles", "RosOut!log"}
    shown |= {"ros2": {"Image!depth", "Plot!/odom"}, "protobuf": {"Image!depth"}, "json": set()}[
        form
    ]
    assert panels.keys() >= shown
    if form == "ros2":
        check_panels(mcaprl.layout(log), Topics.of_log(log))
    with mcaprl.open_bag(log) as kept, mcaprl.open_bag(bag) as own:
        for topic in ("/camera/depth", "/odom"):
            assert kept.times(topic).tolist() == own.times(topic).tolist()
        offset = kept.read("/telemetry", ["lateral_offset_m"]).columns["lateral_offset_m"]
    np.testing.assert_allclose(offset, 3.5 * read.frames[:, 0], rtol=1e-4)
    assert read.action_labels == (
        "linear.x (-1 full brake, 1 full throttle)",
        "angular.z (-1 full right, 1 full left)",
    )


def test_the_bag_of_a_car_with_buttons(buttons: Path) -> None:
    recorded = mcaprl.open(buttons)
    bag = make(buttons, "ros2")
    read = mcaprl.open(bag, mapping=EXAMPLE / "buttons.yaml")
    assert_driver_sees(bag, read)
    assert_same_drives(recorded, read)
    assert read.action_meanings == recorded.action_meanings
    assert [episode.reason for episode in read.episodes] == ["gap", "gap", "stall"]


def test_a_policy_that_learned_from_the_bag_drives_in_the_sim(
    native: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, runs = native.with_name("ros2"), tmp_path / "runs"
    bag = bag if bag.exists() else make(native, "ros2")
    mapping = ["--mapping", str(EXAMPLE / "robot.yaml")]
    train = ["train-offline", str(bag), *mapping, "--algo", "bc", "--updates", "20"]
    assert run([*train, "--out", str(runs)]) == 0
    sim = ["--sim", "lane", "--actions", "continuous"]
    assert run(["evaluate", str(runs), *sim, "--episodes", "2"]) == 0
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
    assert found.dataset.action_part_names == ("linear.x", "angular.z")
    assert found.dataset.action_units == ("m/s", "rad/s")
    # The clock of the suggested mapping is not aligned with the messages of the lane detector.
    # Therefore, some steps are in the pauses between the drives.
    assert len(found.dataset) > 0.9 * len(mcaprl.open(native))
