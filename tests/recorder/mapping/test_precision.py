"""Digits that are lost as float32, with numbers calculated by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mcaprl.recorder.mapping.config import parse_mapping
from mcaprl.recorder.mapping.read import MappedBag, read_open_bag
from mcaprl.recorder.mapping.summary import needed_offset, rounding_of
from tests.support.memory_bag import MemoryBag

K = np.arange(19.0)
# The numbers of float32 are 2^-18 apart from 32 to 64, 0.5 from 2^22, and 2^17 from 2^40.
LATITUDES = 48.137 + 1e-6 * K
UTM_M = 5_331_000 + 0.05 * K
COUNTS = 2.0**40 + K
STAMPS_NS = 1.7e18 + 1e8 * K
SECONDS = 1.7e9 + 0.1 * K


@pytest.mark.parametrize(
    ("values", "kept", "offset"),
    [
        # 18 steps of 1e-6 are 4.7 spacings of 3.8e-6. At -48, numbers near 0.137 are 1.5e-8 apart,
        # more than a hundredth of a step; at -48.1, they are 3.7e-9 apart.
        (LATITUDES, 5, -48.1),
        # 5,330,000 is coarse enough, because numbers near 1000 are 6.1e-5 apart.
        (UTM_M, 3, -5_330_000.0),
        # 2^40 is 1,099,511,627,776: the rest of 27,776 has spacings of 0.002, and 372,224 of 0.03.
        (COUNTS, 1, -1_099_511_600_000.0),
        (STAMPS_NS, 1, -1.7e18),
        (SECONDS, 1, -1.7e9),
    ],
)
def test_values_that_float32_merges(values: Any, kept: int, offset: float) -> None:
    found = rounding_of([values], ["x"], "/gps")
    assert found is not None
    assert (found.values, found.kept, found.offset) == (19, kept, offset)
    assert needed_offset(values) == offset
    # With the offset, the digits are kept, and no other offset is needed.
    shifted = values + offset
    assert len(np.unique(shifted.astype(np.float32))) == 19
    assert rounding_of([shifted], ["x"], "/gps") is None
    # An offset of the mapping is a part of the offset to set.
    again = rounding_of([values + 0.5], ["x"], "/gps", 0.5)
    assert again is not None
    assert again.offset is not None
    assert len(np.unique((values + again.offset).astype(np.float32))) == 19


def ordinary() -> dict[str, Any]:
    random = np.random.default_rng(3)
    noise = random.normal(size=2000)
    drive = np.cumsum(np.repeat([0, 0.05], 1000)) + 1e-9 * noise
    return {
        "a noisy acceleration": 9.81 + 0.02 * noise,
        "an odometer": 500 + drive,
        "a battery": 24 + 0.001 * np.round(noise),
        "a joint at rest, with noise of the simulation": 0.5 + 1e-10 * noise,
        "errors of float64": np.where(noise > 0, 0.3, 0.1 + 0.2),
        "one value": np.full(100, 48.137123456),
        "small counts": np.arange(2000.0),
        "float32 numbers": (1e6 * noise).astype(np.float32).astype(np.float64),
        "positions and stops": np.where(np.arange(2000) % 100 < 90, 0.1, 0.3),
        "nothing": np.empty(0),
        "gaps": np.full(5, np.nan),
    }


@pytest.mark.parametrize("name", ordinary())
def test_ordinary_values_need_no_offset(name: str) -> None:
    values = ordinary()[name]
    assert rounding_of([values], ["x"], "/imu") is None
    assert needed_offset(values) is None


def test_stops_jumps_and_runs_do_not_hide_the_loss() -> None:
    # A receiver without a fix reports 0.
    there_and_back = np.tile(np.r_[LATITUDES, LATITUDES[::-1]], 10)
    broken = np.where(np.arange(380) == 7, 0.0, there_and_back)
    assert rounding_of([np.r_[np.full(5000, LATITUDES[0]), broken]], ["x"], "/gps") is not None
    # The difference between two runs is not a step.
    assert rounding_of([LATITUDES, LATITUDES + 5], ["x"], "/gps") is not None


def test_the_worst_element_is_named() -> None:
    table = np.column_stack([np.arange(19.0) / 3, LATITUDES, COUNTS])
    found = rounding_of([table], ["x_0", "x_1", "x_2"], "/gps")
    assert found is not None
    assert (found.element, found.elements, found.is_alone) == ("x_2", 2, False)
    assert "in a separate entry" in found.advice()


def read(values: Any, **parts: Any) -> MappedBag:
    """Read a bag with a latitude at each of 19 seconds."""
    times = np.arange(float(len(values))).tolist()
    topics = {
        "/gps": (times, {"latitude": values}),
        "/cmd": (times, {"data": values, "zero": np.zeros(len(values))}),
    }
    tree = {
        "clock": {"rate_hz": 1},
        "observation": {"lat": {"field": "/gps.latitude"}},
        "action": {"field": "/cmd.zero"},
        **parts,
    }
    return read_open_bag(MemoryBag(topics), parse_mapping(tree))


def test_the_report_has_the_offset_to_write() -> None:
    report = read(LATITUDES).report
    (problem,) = report.problems()
    assert str(problem) == (
        "float32 is too coarse for lat: 19 different values become 5, and 1e-06 is a typical change"
        " (/gps); set `offset: -48.1`; it is added before the values are rounded"
    )
    assert report.to_json()["rounded"]["lat"]["offset"] == -48.1
    offset = {"lat": {"field": "/gps.latitude", "offset": -48.1}}
    data, report = read(LATITUDES, observation=offset)
    assert not report.problems()
    assert len(np.unique(data.frames)) == 19


def test_a_box_action_loses_digits_too() -> None:
    zero = {"x": {"field": "/gps.latitude", "offset": -48.1}}
    box = {"fields": ["/cmd.data"], "box": {"low": [0], "high": [99]}}
    report = read(LATITUDES, observation=zero, action=box).report
    assert [str(each).split(":")[0] for each in report.problems()] == [
        "float32 is too coarse for /cmd.data"
    ]
    assert "no `offset` can keep" in str(report.problems()[0])


def test_values_beyond_float32_are_missing() -> None:
    found = read([0.0, 1.0, 2.0, 1e300, 4.0, 5.0, 6.0])
    assert [each.length for each in found.dataset.episodes] == [2, 2]
    assert found.dataset.observations.ravel().tolist() == [0, 1, 4, 5]
    assert found.report.fields["lat"].missing == pytest.approx(1 / 7)
