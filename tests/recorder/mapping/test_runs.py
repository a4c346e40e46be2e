"""Bags with several publishers, several files and resets of the clock, with numbers by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mcaprl.recorder.mapping.config import parse_mapping
from mcaprl.recorder.mapping.read import MappedBag, read_bag
from tests.support.bags import integers, numbers, write_channels


def read(paths: Any, **parts: Any) -> MappedBag:
    """Read bags with the observation `/odom`, the action `/cmd` and 10 steps per second."""
    tree = {
        "clock": {"rate_hz": 10},
        "observation": {"x": {"field": "/odom.data"}},
        "action": {"field": "/cmd.data"},
        **parts,
    }
    return read_bag(paths, parse_mapping(tree))


def test_two_publishers_of_a_topic_are_one_stream(tmp_path: Path) -> None:
    # Each topic has one channel for even steps and one for odd steps.
    odom = [numbers("/odom", [(k / 10, k) for k in range(first, 100, 2)]) for first in (0, 1)]
    cmd = [integers("/cmd", [(k / 10, k % 2) for k in range(first, 100, 2)]) for first in (0, 1)]
    found = read(write_channels(tmp_path / "bag.mcap", [*odom, *cmd]))
    assert found.report.clock_resets == 0
    assert [episode.length for episode in found.dataset.episodes] == [99]
    assert found.dataset.observations.ravel().tolist() == list(range(99))
    assert found.dataset.actions.tolist() == [k % 2 for k in range(99)]
