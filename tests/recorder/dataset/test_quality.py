"""Planted faults are found by kind, place and number; clean data have no problems."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from gymnasium import spaces

import mcaprl
from mcaprl.cli import cli, main
from mcaprl.errors import UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.quality import Flaw, flaws
from tests.support import bags
from tests.support.damage import planted as faults

EPISODES, STEPS = 24, 30


def arm(seed: int = 0, *, camera: bool = False, is_depth: bool = False) -> Dataset:
    """Return episodes of two joints that follow velocity commands with a first-order lag."""
    random = np.random.default_rng(seed)
    columns: dict[str, list[Any]] = {"observations": [], "next_observations": [], "actions": []}
    rewards = []
    for _ in range(EPISODES):
        position, velocity = random.normal(size=2), np.zeros(2)
        frames, actions = [np.concatenate([position, velocity])], []
        for _ in range(STEPS):
            action = np.clip(0.6 * random.normal(size=2) - 0.3 * position, -1, 1)
            velocity = velocity + 0.5 * (action - velocity) + 0.02 * random.normal(size=2)
            position = position + 0.1 * velocity
            frames.append(np.concatenate([position, velocity]))
            actions.append(action)
        columns["observations"] += frames[:-1]
        columns["next_observations"] += frames[1:]
        columns["actions"] += actions
        rewards += [-float(np.abs(frame[:2]).sum()) for frame in frames[1:]]
    ends = np.arange(1, EPISODES * STEPS + 1) % STEPS == 0
    arrays: dict[str, Any] = {name: np.array(rows, np.float32) for name, rows in columns.items()}
    space: spaces.Space[Any] = spaces.Box(-np.inf, np.inf, (4,), np.float32)
    if camera:
        dtype: Any = np.float32 if is_depth else np.uint8
        image = spaces.Box(0, 255, (16, 16, 1), dtype)
        space = spaces.Dict({"camera": image, "joints": space})
        for name in ("observations", "next_observations"):
            joints = arrays[name]
            across = np.arange(256).reshape(16, 16, 1) + 640 * joints[:, :1, None, None]
            pixels = (across % 256).astype(np.uint8)
            # Of depth, in meters, the whole range is 2.55 m.
            pixels = (pixels / np.float32(100)).astype(dtype) if is_depth else pixels
            arrays[name] = {"camera": pixels, "joints": joints}
    return Dataset.from_arrays(
        **arrays,
        rewards=np.array(rewards),
        terminated=np.zeros(len(ends), bool),
        truncated=ends,
        observation_space=space,
        action_space=spaces.Box(-1, 1, (2,), np.float32),
    )


@pytest.fixture(scope="module")
def clean() -> Dataset:
    """Return clean data."""
    return arm()


def problems(data: Dataset, **more: Any) -> list[Flaw]:
    """Return the findings that are no notes."""
    return [flaw for flaw in flaws(data, **more) if flaw.severity == "problem"]


@pytest.mark.parametrize("seed", range(5))
def test_clean_data_have_no_problems(seed: int) -> None:
    assert problems(arm(seed)) == []


@pytest.mark.parametrize("kind", faults.FAULTS)
def test_a_planted_fault_is_found_and_tells_what_to_do(clean: Dataset, kind: str) -> None:
    found = problems(faults.FAULTS[kind](clean, np.random.default_rng(3)))
    assert kind in {flaw.kind for flaw in found}, found
    for flaw in found:
        assert flaw.next
        assert 0 < flaw.share <= 1
        assert flaw.plot is not None
        assert len(flaw.plot.x) == len(flaw.plot.y)


@pytest.mark.parametrize("is_depth", [False, True])
@pytest.mark.parametrize("kind", faults.IMAGE_FAULTS)
def test_faults_of_a_camera_are_found_and_a_clean_one_is_not(kind: str, is_depth: bool) -> None:
    data = arm(camera=True, is_depth=is_depth)
    assert problems(data) == []
    (flaw,) = problems(faults.IMAGE_FAULTS[kind](data, np.random.default_rng(1)))
    assert flaw.kind == kind
    assert "camera" in flaw.what


def test_the_place_of_a_frozen_sensor_is_exact(clean: Dataset) -> None:
    """Frames 10 to 21 of episode 2 are alike, so steps 10 to 20 change nothing.

    The period is 0.1 s.
    """
    k, leaf = faults.vector(clean)
    first = 2 * (STEPS + 1) + 10
    leaf[first : first + 12] = leaf[first]
    (flaw,) = [one for one in problems(faults.with_leaf(clean, k, leaf)) if one.kind == "frozen"]
    (place,) = flaw.places
    assert place[:3] == (2, 10, 20)
    assert flaw.figure == 11
    period_s = np.diff(clean.episodes[2].log_time_ns[:2])[0] / 1e9
    assert place.from_s == pytest.approx(10 * period_s)
    assert flaw.share == pytest.approx(11 / (EPISODES * STEPS))


@pytest.mark.parametrize(("frames", "at_rest", "found"), [(6, 0, 1), (5, 0, 0), (12, 1, 0)])
def test_a_robot_at_rest_is_not_frozen(
    clean: Dataset, frames: int, at_rest: int, found: int
) -> None:
    """Five steps without change are needed, in which actions or rewards do change."""
    k, leaf = faults.vector(clean)
    frame, step = 2 * (STEPS + 1) + 10, 2 * STEPS + 10
    leaf[frame : frame + frames] = leaf[frame]
    leaf[frame + frames : 3 * (STEPS + 1)] += 1
    actions, rewards = clean.actions.copy(), clean.rewards.copy()
    if at_rest:
        actions[step : step + frames] = 0
        rewards[step : step + frames] = 0
    data = faults.changed(faults.with_leaf(clean, k, leaf), actions=actions, rewards=rewards)
    assert [one.kind for one in problems(data)].count("frozen") == found


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_a_lag_is_found_in_steps(clean: Dataset, steps: int) -> None:
    parts = np.split(clean.actions, EPISODES)
    late = [np.concatenate([one[steps:], one[-steps:]]) for one in parts]
    data = faults.changed(clean, actions=np.concatenate(late))
    (flaw,) = [one for one in problems(data) if one.kind == "lag"]
    assert flaw.figure == steps


def test_the_last_action_in_the_observation_is_no_leak(clean: Dataset) -> None:
    k, leaf = faults.vector(clean)
    leaf[clean.frame_of_step + 1, 3] = clean.actions[:, 0]
    assert "leak" not in {one.kind for one in flaws(faults.with_leaf(clean, k, leaf))}


def test_bang_bang_control_is_not_saturated_and_bounds_are_a_note(clean: Dataset) -> None:
    bang = faults.changed(clean, actions=np.sign(clean.actions))
    assert "saturated" not in {one.kind for one in flaws(bang)}
    hard = faults.changed(clean, actions=np.clip(3 * clean.actions, -1, 1))
    assert {one.severity for one in flaws(hard) if one.kind == "saturated"} == {"note"}


def test_episodes_that_are_in_the_test_data_too_are_named(clean: Dataset) -> None:
    test = clean.filter(lambda episode: episode.index in (3, 7))
    (flaw,) = problems(clean, test=test)
    assert (flaw.kind, flaw.figure) == ("duplicates", 2)
    assert "also in the test data" in flaw.what
    assert [place[0] for place in flaw.places] == [3, 7]
    assert problems(clean, test=arm(1)) == []


def test_findings_are_ranked_by_their_share(clean: Dataset) -> None:
    random = np.random.default_rng(0)
    found = problems(faults.leak(faults.drops(clean, random), random))
    assert [one.share for one in found] == sorted((one.share for one in found), reverse=True)
    assert found[0].kind == "leak"


def test_a_bag_is_evaluated_through_its_mapping(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 240 odometry messages at 10 Hz, those from the 20th to the 29th are alike."""
    monkeypatch.setattr(bags, "STEPS", 240)
    monkeypatch.setattr(bags, "speed", lambda step: float(20 if 20 <= step < 30 else step))
    bag = bags.write_rosbag2(tmp_path / "bag")
    mapping = tmp_path / "robot.yaml"
    mapping.write_text(
        "clock: {topic: /odom}\n"
        "observation: {speed: {field: /odom.twist.twist.linear.x}}\n"
        "action: {fields: [/cmd_vel.angular.z], box: {low: -1, high: 1}}\n"
    )
    options = ["info", str(bag), "--mapping", str(mapping), "--quality", "--json"]
    quality = json.loads(CliRunner().invoke(cli, options).stdout)["quality"]
    (flaw,) = [one for one in quality if one["kind"] == "frozen"]
    assert flaw["figure"] == 9
    assert [place["first"] for place in flaw["places"]] == [20]
    assert [place["last"] for place in flaw["places"]] == [28]


def test_the_command_the_function_and_the_page(
    clean: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "bad.mcap"
    faults.frozen(clean, np.random.default_rng(3)).save(log)
    found = mcaprl.info(log, quality=True, report=tmp_path / "page").quality or []
    shown = CliRunner().invoke(cli, ["info", str(log), "--quality", "--json"])
    assert json.loads(shown.output)["quality"] == json.loads(
        json.dumps([flaw.to_json() for flaw in found])
    )
    with pytest.raises(SystemExit) as strict:
        main(["info", str(log), "--quality", "--strict"])
    assert strict.value.code == 1
    assert "stay the same for" in capsys.readouterr().out
    page = (tmp_path / "page" / "index.html").read_text()
    assert "Plots of the findings" in page
    assert "leave these steps out" in page
    clean.save(test := tmp_path / "test.mcap")
    options = ["info", str(log), "--quality", "--json", "--test", str(test)]
    for more, copies in ([], EPISODES - 1), (["--only", "episode < 2"], 2):
        facts = json.loads(CliRunner().invoke(cli, [*options, *more]).stdout)
        (same,) = [one for one in facts["quality"] if one["kind"] == "duplicates"]
        assert abs(same["figure"] - copies) <= 1
    assert mcaprl.info(log).quality is None
    with pytest.raises(UsageError, match="quality=True"):
        mcaprl.info(log, test=log)
