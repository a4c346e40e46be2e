"""Labels of a bag: made by a mapping, used in its expressions, and refused for other episodes."""

from __future__ import annotations

import json
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import LogError, NoEpisodesError, UsageError
from mcaprl.recorder.dataset.labels import labels_of
from mcaprl.recorder.edit.piece import selected
from tests.drive.test_driver import commanded, linear
from tests.drive.test_driver import drive as driver_of
from tests.support.bags import integers, numbers, write_channels, write_rosbag1, write_rosbag2

MAPPING: dict[str, Any] = {
    "clock": {"rate_hz": 10},
    "observation": {"x": {"field": "/odom.data"}},
    "action": {"field": "/cmd.data"},
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record two drives of 10 steps at 10 Hz, with a pause of 5 s; x counts from 0 and from 100."""
    times = [(k / 10, k) for k in range(11)] + [(6 + k / 10, 100 + k) for k in range(11)]
    odom, cmd = numbers("/odom", times), integers("/cmd", [(t, k % 2) for t, k in times])
    return write_channels(tmp_path_factory.mktemp("bag") / "bag.mcap", [odom, cmd])


@pytest.fixture
def bag(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(recorded, tmp_path / "bag.mcap"))


def label(bag: Path) -> None:
    mcaprl.label(bag, mapping=MAPPING, episode=0, success=True, note="clean")
    mcaprl.label(bag, mapping=MAPPING, episode=1, success=False)
    mcaprl.label(bag, mapping=MAPPING, episode=1, interval="bad data", steps=(2, 4))


def read(bag: Path, **changes: Any) -> mcaprl.Dataset:
    return mcaprl.open(bag, mapping={**MAPPING, **changes})


def test_the_reward_uses_labels(bag: Path) -> None:
    label(bag)
    found = mcaprl.label(bag, mapping=MAPPING)
    assert found.rows() == [["0", "success", "clean", ""], ["1", "failure", "", "bad data 2:4"]]
    # `terminated` is the last transition that x of 10 or 110 ends.
    ends = {"episodes": {"terminated": "x == 10 or x == 110"}}
    reward = "labels.success * terminated - labels.bad_data - 5 * labels.crash"
    data = read(bag, reward=reward, **ends)
    assert data.rewards.tolist() == [0] * 9 + [1] + [0, 0, -1, -1] + [0] * 6
    texts = read(bag, reward="labels.note == 'clean'").rewards
    assert texts.tolist() == [1] * 10 + [0] * 10
    # A condition that is missing at all steps changes nothing.
    assert read(bag).fingerprint == read(bag, episodes={"truncated": "labels.crash"}).fingerprint


def test_conditions_divide_episodes_at_labels(bag: Path) -> None:
    label(bag)
    data = read(bag, episodes={"truncated": "labels.bad_data", "min_steps": 1})
    # The flagged observations of the second drive, 102 and 103, end or prevent episodes.
    assert [
        one.observations[:, 0].tolist()[:: max(one.length - 1, 1)] for one in data.episodes
    ] == [
        [0, 9],
        [100, 101],
        [104, 109],
    ]
    found = labels_of(data)
    assert found is not None
    assert found.success == {"0": True, "1": False, "2": False}
    assert found.notes == {"0": "clean"}
    assert found.intervals == []
    reasons = {"truncated": "labels.bad_data", "reasons": {"bad": "labels.bad_data"}}
    assert [one.reason for one in read(bag, episodes=reasons).episodes][1] == "bad"
    begun = read(bag, episodes={"begin": "labels.bad_data"})
    assert begun.observations.ravel().tolist() == list(range(102, 110))
    # The labels are still those of the episodes without this condition.
    mapping = {**MAPPING, "episodes": {"begin": "labels.bad_data"}}
    assert mcaprl.label(bag, mapping=mapping).success == {"0": True, "1": False}


@pytest.mark.filterwarnings("ignore:.*has no labels")
def test_missing_labels_have_a_value(bag: Path) -> None:
    assert mcaprl.label(bag, mapping={**MAPPING, "reward": "labels.success"}).rows() == []
    with pytest.raises(UsageError, match=r"nan at .*isnan\(labels\.success\)"):
        read(bag, reward="labels.success")
    values = "isnan(labels.success) + 2 * (labels.note == '') + 4 * (not labels.crash)"
    assert set(read(bag, reward=values).rewards.tolist()) == {7}
    assert set(read(bag, reward="labels.success == 1 or 3").rewards.tolist()) == {1}
    with pytest.warns(UserWarning, match=r"bag\.mcap has no labels, .* uses: labels\.crash"):
        read(bag, reward="labels.crash")


def test_episodes_are_selected_and_masked(bag: Path) -> None:
    label(bag)
    data = read(bag)
    assert selected(data, "success == 1").observations.ravel().tolist() == list(range(10))
    assert selected(data, "labels.note == 'clean'").observations.max() == 9
    assert selected(data, "not labels.bad_data").observations.max() == 9
    masked = selected(data, mask=["bad data"])
    assert masked.episode_lengths.tolist() == [10, 2, 6]
    assert masked.wholes.tolist() == [0, 1, 1]
    with pytest.raises(NoEpisodesError):
        selected(data, "labels.crash")
    with pytest.raises(UsageError, match="for all of their episodes only"):
        selected(selected(data, "length > 0").filter(lambda one: one.index == 0), "success == 1")


def test_other_episodes_and_other_bags_are_refused(bag: Path, tmp_path: Path) -> None:
    label(bag)
    data = read(bag, episodes={"gap_s": 10})
    for use in (
        lambda: read(bag, episodes={"gap_s": 10}, reward="labels.success"),
        lambda: selected(data, "success == 1"),
        lambda: mcaprl.convert(data, tmp_path / "out.mcap"),
    ):
        with pytest.raises(LogError, match="other episodes than the 1 episode that the mapping"):
            use()
    assert not (tmp_path / "out.mcap").exists()
    with pytest.raises(LogError, match="other episodes than the 2 episodes"):
        mcaprl.label(bag, mapping={**MAPPING, "clock": {"rate_hz": 5}}, episode=0, success=True)
    # What is not in the episodes may change, and so may the place of the bag.
    assert read(bag, stack=2, reward="x").rewards[0] == 0
    (tmp_path / "new").mkdir()
    for path in (bag, Path(f"{bag}.labels.json")):
        path.rename(tmp_path / "new" / path.name)
    assert mcaprl.label(tmp_path / "new" / bag.name, mapping=MAPPING).notes == {"0": "clean"}
    odom, cmd = numbers("/odom", [(0, 1), (9, 1)]), integers("/cmd", [(0, 1), (9, 1)])
    write_channels(tmp_path / "new" / "bag.mcap", [odom, cmd])
    with pytest.raises(LogError, match="other data"):
        read(tmp_path / "new" / "bag.mcap", episodes={"gap_s": 10}, reward="labels.success")


@pytest.mark.parametrize("form", ["rosbag2", "bag", "folder"])
def test_labels_are_beside_the_recording(form: str, recorded: Path, tmp_path: Path) -> None:
    """The labels of a split bag are beside its folder; all but the paths are those of MCAP."""
    mapping: dict[str, Any] = {
        "clock": {"rate_hz": 10},
        "observation": {"x": {"field": "/odom.twist.twist.linear.x"}},
        "action": {"fields": ["/cmd_vel.angular.z"], "box": {"low": -9, "high": 9}},
        "reward": "labels.success",
    }
    if form == "rosbag2":
        path = write_rosbag2(tmp_path / "drive", "sqlite3")
    elif form == "bag":
        path = write_rosbag1(tmp_path / "drive.bag")
    else:
        (tmp_path / "drive").mkdir()
        part = shutil.copy(recorded, tmp_path / "drive" / "drive_0.mcap")
        metadata = "rosbag2_bagfile_information: {relative_file_paths: [drive_0.mcap]}"
        (tmp_path / "drive" / "metadata.yaml").write_text(metadata)
        path, mapping = Path(part), {**MAPPING, "reward": "labels.success"}
    for episode in range(2 if form == "folder" else 1):
        mcaprl.label(path, mapping=mapping, episode=episode, success=True)
    name = "drive.bag.labels.json" if form == "bag" else "drive.labels.json"
    assert (tmp_path / name).is_file()
    assert set(mcaprl.open(path, mapping=mapping).rewards.tolist()) == {1}


def test_recordings_have_their_own_labels(bag: Path) -> None:
    """Two recordings, of which the second one is read first by its times, and has no labels."""
    odom = [(k / 10 - 100, -k) for k in range(11)]
    cmd = [(t, 1) for t, _ in odom]
    other = write_channels(
        bag.with_name("early.mcap"), [numbers("/odom", odom), integers("/cmd", cmd)]
    )
    label(bag)
    with pytest.raises(UsageError, match="one recording: name one of the 2"):
        mcaprl.label(bag.parent, mapping=MAPPING)
    data = mcaprl.open([bag, other], mapping={**MAPPING, "reward": "labels.bad_data"})
    assert data.observations[:2].ravel().tolist() == [0, -1]
    assert np.flatnonzero(data.rewards).tolist() == [22, 23]
    found = labels_of(data)
    assert found is not None
    assert found.success == {"1": True, "2": False}


def test_commands_read_the_labels(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "map.yaml"
    file.write_text(
        "clock: {rate_hz: 10}\nobservation: {x: {field: /odom.data}}\naction: {field: /cmd.data}\n"
        "reward: labels.success\n"
    )
    ask = ["label", str(bag), "--mapping", str(file), "--episode"]
    assert run([*ask, "0", "--success"]) == 0
    assert run([*ask, "1", "--failure"]) == 0
    assert run([*ask, "1", "--interval", "bad data", "--steps", "2:4"]) == 0
    assert run(["info", str(bag), "--mapping", str(file)]) == 0
    assert run(["check", str(bag), "--mapping", str(file)]) == 0
    capsys.readouterr()
    log = tmp_path / "log.mcap"
    assert run(["convert", str(bag), str(log), "--mapping", str(file)]) == 0
    # The log of the bag has its rewards and its labels.
    assert mcaprl.open(log).rewards.tolist() == [1] * 10 + [0] * 10
    assert mcaprl.label(log).rows() == mcaprl.label(bag, mapping=file).rows()
    out = tmp_path / "annotated.mcap"
    assert run(["annotate", str(bag), "--out", str(out), "--mapping", str(file)]) == 0
    assert mcaprl.label(out).success == {"0": True, "1": False}
    ask = ["train-offline", str(bag), "--mapping", str(file), "--algo", "bc", "--updates", "2"]
    out = tmp_path / "run"
    assert run([*ask, "--only", "success == 1", "--mask", "bad data", "--out", str(out)]) == 0
    assert json.loads((out / "config.json").read_text())["transitions"] == 10


@pytest.mark.filterwarnings("ignore:.*has no labels")
def test_robots_have_no_labels(tmp_path: Path) -> None:
    command = {"fields": ["/do.linear.x"], "box": {"low": -1, "high": 1}}
    tree: dict[str, Any] = {
        "reward": "isnan(labels.success)",
        "episodes": {"begin": "not labels.bad"},
    }
    driver = driver_of(command, [linear(0.5), linear(-0.5)], lambda _: np.array([0.25]), **tree)
    with closing(driver):
        driver.record(tmp_path / "drive.mcap")
        assert commanded(driver, 5)[0]["linear"]["x"] == 0.25
    assert mcaprl.open(tmp_path / "drive.mcap").rewards.tolist() == [0, 0, 0, 0]
    acted = {"expressions": ["labels.success * 1"], "box": {"low": -1, "high": 1}}
    with pytest.raises(UsageError, match=r"expressions\.0: an action cannot depend on labels"):
        driver_of(acted, [linear(0.5), linear(-0.5)])
