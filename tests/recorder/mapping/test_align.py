"""Alignment of messages with steps, compared with a reference that reads one message at a time."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mcaprl.recorder.mapping.align import NONE, during, interpolated, last, nearest, time_order

TIMES_NS = np.array([100, 200, 200, 500], np.int64)
STEPS_NS = np.array([50, 100, 150, 200, 360, 350, 600], np.int64)


def test_last_message_up_to_each_step_by_hand() -> None:
    match = last(TIMES_NS, STEPS_NS, None)
    # If two messages have the same time, the second one counts as the last.
    assert match.rows.tolist() == [NONE, 0, 0, 2, 2, 2, 3]
    np.testing.assert_allclose(
        match.age_s * 1e9, [math.nan, 0, 50, 0, 160, 150, 100], equal_nan=True
    )
    assert last(TIMES_NS, STEPS_NS, 1e-7).rows.tolist() == [NONE, 0, 0, 2, NONE, NONE, 3]


def test_nearest_message_by_hand() -> None:
    match = nearest(TIMES_NS, STEPS_NS, None)
    assert match.rows.tolist() == [0, 0, 0, 2, 3, 2, 3]
    np.testing.assert_allclose(match.age_s * 1e9, [-50, 0, 50, 0, -140, 150, 100])


def test_last_message_before_the_end_of_a_step_by_hand() -> None:
    steps_ns, ends_ns = np.array([0, 100, 200]), np.array([100, 200, 600])
    assert during(TIMES_NS, steps_ns, ends_ns, None).rows.tolist() == [NONE, 0, 3]


def test_linear_interpolation_by_hand() -> None:
    times_ns = np.array([100, 200, 500])
    found, match = interpolated(times_ns, np.array([1.0, 2.0, 8.0]), STEPS_NS, None)
    np.testing.assert_allclose(found, [math.nan, 1.0, 1.5, 2.0, 5.2, 5.0, math.nan], equal_nan=True)
    assert match.rows.tolist() == [NONE, 0, 0, 1, 1, 1, NONE]
    found, _ = interpolated(times_ns, np.array([1.0, 2.0, 8.0]), STEPS_NS, 1.5e-7)
    np.testing.assert_allclose(
        found, [math.nan, 1.0, 1.5, 2.0, math.nan, 5.0, math.nan], equal_nan=True
    )


def test_no_messages_match_nothing() -> None:
    none = np.empty(0, np.int64)
    for match in (last(none, STEPS_NS, None), nearest(none, STEPS_NS, 1.0)):
        assert match.rows.tolist() == [NONE] * len(STEPS_NS)
        assert np.isnan(match.age_s).all()
    found, _ = interpolated(none, np.empty((0, 2)), STEPS_NS, None)
    assert found.shape == (len(STEPS_NS), 2)
    assert np.isnan(found).all()


times = st.lists(st.integers(0, 40), max_size=12)


@given(times, times, st.none() | st.integers(0, 15))
def test_alignment_equals_a_search_message_by_message(
    messages: list[int], steps: list[int], tolerance: int | None
) -> None:
    order = time_order(np.array(messages, np.int64))
    times_ns = np.array(messages, np.int64)[order]
    steps_ns = np.array(sorted(set(steps)), np.int64)
    limit_s = None if tolerance is None else tolerance / 1e9

    def reference(step: int, kind: str) -> int:
        best = NONE
        for row, time in enumerate(times_ns.tolist()):
            if kind == "last" and time > step:
                continue
            if kind == "nearest" and best != NONE:
                closer = abs(time - step) < abs(times_ns[best] - step)
                same_time = time == times_ns[best] and time <= step
                if not (closer or same_time):
                    continue
            best = row
        if best != NONE and tolerance is not None and abs(times_ns[best] - step) > tolerance:
            return NONE
        return best

    assert last(times_ns, steps_ns, limit_s).rows.tolist() == [
        reference(step, "last") for step in steps_ns.tolist()
    ]
    found = nearest(times_ns, steps_ns, limit_s).rows.tolist()
    expected = [reference(step, "nearest") for step in steps_ns.tolist()]
    # If several messages have the same time, any of them can be the nearest. Compare only times.
    assert [times_ns[k] if k != NONE else None for k in found] == [
        times_ns[k] if k != NONE else None for k in expected
    ]
