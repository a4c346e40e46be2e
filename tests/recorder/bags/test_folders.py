"""Folders of bags: which paths are opened, and what is ignored."""

from __future__ import annotations

import os
import warnings
from contextlib import closing
from pathlib import Path

import pytest

from mcaprl.errors import LogError
from mcaprl.recorder.bags import files
from mcaprl.recorder.bags.bag import open_bag
from mcaprl.recorder.bags.files import find_bags
from tests.support.bags import STEP_NS, STEPS, numbers, write_channels, write_rosbag2

PARTS = 3


@pytest.fixture
def season(tmp_path: Path) -> Path:
    """Folder with three rosbag2 folders on two levels, two MCAP files, and folders of notes."""
    folder = tmp_path / "season"
    (folder / "day" / "notes" / "more").mkdir(parents=True)
    (folder / "calibration").mkdir()
    (folder / "calibration" / "camera.yaml").write_text("a: 1\n")
    (folder / ".cache").mkdir()
    write_rosbag2(folder / "day", parts=PARTS)
    for name, start_s in (("b.mcap", 100.0), ("day/a.mcap", 200.0)):
        write_channels(folder / name, [numbers("/odom_x", [(start_s, 1.0)])])
    return folder


def test_bags_in_folders_are_found_by_name(season: Path) -> None:
    with pytest.warns(UserWarning, match="^ignored, because") as caught:
        found = find_bags(season)
    names = ["day", "day/part_0", "day/part_1", "day/part_2"]
    assert found == [season, *(season / name for name in names)]
    texts = sorted(str(each.message) for each in caught)
    assert texts == [
        f"ignored, because they are not bags: {season / 'calibration'}",
        f"ignored, because they are not bags: {season / 'day' / 'notes'}",
    ]


@pytest.mark.filterwarnings("ignore:ignored, because")
def test_a_folder_of_bags_equals_the_list_of_them(season: Path) -> None:
    given = [*(season / "day" / f"part_{k}" for k in range(PARTS))]
    given += [season / "b.mcap", season / "day" / "a.mcap"]
    # A path that is given twice is read once.
    for paths in (season, given, [*given, *given]):
        with closing(open_bag(paths)) as bag:
            assert len(bag.paths) == PARTS + 2
            assert bag.topics["/odom"].count == STEPS
            assert bag.topics["/odom_x"].count == 2
            assert bag.times("/odom")[-1] - bag.times("/odom")[0] == (STEPS - 1) * STEP_NS


def test_a_glob_ignores_notes_beside_bags(season: Path) -> None:
    (season / "notes.txt").write_text("rain")
    with pytest.warns(UserWarning, match="^ignored, because") as caught:
        found = find_bags(str(season / "*"))
    ignored = f"{season / 'calibration'}, {season / 'notes.txt'}"
    assert str(caught[-1].message) == f"ignored, because they are not bags: {ignored}"
    assert [path.name for path in found] == ["b.mcap", "day", "part_0", "part_1", "part_2"]


def test_a_folder_without_bags_says_what_was_searched(tmp_path: Path) -> None:
    (tmp_path / "notes" / "deep").mkdir(parents=True)
    with pytest.raises(LogError, match=r"notes has no \.mcap, \.db3, \.bag files, nor do its fold"):
        find_bags(tmp_path / "notes")
    with pytest.raises(LogError, match="no such file, folder or match"):
        find_bags(str(tmp_path / "none*"))


def test_the_search_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deep = tmp_path / "1" / "2" / "3"
    deep.mkdir(parents=True)
    write_channels(deep / "x.mcap", [numbers("/x", [(0.0, 1.0)])])
    # A link to a folder above does not add bags.
    os.symlink(tmp_path, deep / "loop")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert find_bags(tmp_path) == [deep]
        (deep / "4").mkdir()
        (deep / "x.mcap").rename(deep / "4" / "x.mcap")
        with pytest.raises(LogError, match="nor do its folders"):
            find_bags(tmp_path)
        monkeypatch.setattr(files, "_MAX_ENTRIES", 4)
        with pytest.raises(LogError, match="more than 4 files and folders"):
            find_bags(tmp_path)
