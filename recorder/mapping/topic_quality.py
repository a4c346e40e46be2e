"""What is wrong with the topics of a bag: their times, repeated messages, frames of cameras.

A message is compared with the one before it, without stamps and sequence numbers. A sensor that
stands still may repeat its message, too. So a repetition is a fault only if the topic changes in
nearly all other messages, has the same content nowhere else, and

- jumps afterwards, as what it measures has moved on meanwhile: half of its moving numbers by at
  least 1.5 times their changes before and after, while a value at rest begins with small ones; or
- its numbers are noise, which does not stand still: what they change in two messages is not more
  than in one, and no other message is like the one before it. They must change as usual before and
  after the repetition.

Numbers that are held at 0, or at a value that they have elsewhere, prove nothing. Of an
image, a small copy is read. Frames of videos are compared by this copy, other messages by their
bytes or fields.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcaprl.errors import LogError, UsageError
from mcaprl.recorder.bags.bag import OpenBag, TopicInfo
from mcaprl.recorder.bags.overview import TopicOverview
from mcaprl.recorder.bags.values import NUMBERS
from mcaprl.recorder.dataset.quality import (
    DARK,
    DROP,
    HELD,
    JITTER,
    NS_PER_S,
    PLACES,
    Flags,
    Flaw,
    Floats,
    Plot,
    Rows,
    TopicPlace,
    is_usual,
    longest,
    ranked,
    robust_spread,
    shown,
)
from mcaprl.recorder.mapping.config import Quantity
from mcaprl.recorder.mapping.images import ImageReader
from mcaprl.recorder.mapping.likely import ELEMENTS, IMAGES, kind_of
from mcaprl.recorder.mapping.likely import NUMBERS as NUMBER_KINDS
from mcaprl.texts import counted

_FEWEST: Final = 20
"""Messages outside of repetitions that a topic needs to be evaluated."""
_BYTES: Final = 1 << 28
_READ: Final = 1 << 25
"""Size of the messages of a topic that are compared, and of those in memory at a time."""
_MESSAGES: Final = 200_000
_FRAMES: Final = 300
"""Most messages of a topic that are compared, and most frames that are decoded."""
_BLOCKS: Final = 20
"""Number of blocks of successive messages that are compared if the topic has more."""
_THUMBNAIL: Final = (16, 12)
_LOSS: Final = 3
"""Most by which a codec changes a pixel of the small copies of frames that were alike."""
_COLUMNS: Final = 40
_SUSPECTS: Final = 20
_LIVELY: Final = 0.95
_ROUGH: Final = 1.2
"""Ratio of changes in two messages to those in one below which numbers are noise: 1 for white
noise, 1.4 for a random walk, 2 for a constant speed."""
_STRAY: Final = 0.001
_JUMP: Final = 1.5
_ABRUPT: Final = 0.1
"""Change before and after a repetition, in usual changes, below which the value came to rest."""
_REGULAR: Final = 0.8
_TICKING: Final = {"seq", "sequence", "counter", "stamp", "timestamp", "timestamp_sample"}
_SHOWN_POINTS: Final = 400
_INTERVAL: Final = "seconds until the next message"


class Looked(NamedTuple):
    """How much of a topic was read: its messages, and those that were compared and decoded."""

    messages: int
    compared: int
    decoded: int = 0


class _Times:
    """Messages of a topic, and their times."""

    def __init__(self, name: str, times_ns: Rows, recordings: Rows, start_ns: int) -> None:
        self.name, self.recordings = name, recordings
        self.times_ns = times_ns
        self.seconds: Floats = (times_ns - start_ns) / NS_PER_S

    def flaw(self, runs: Sequence[tuple[int, int]], what: str, **more: Any) -> Flaw:
        """Return the flaw of runs of messages, first and last."""
        places = tuple(
            TopicPlace(self.name, *run, *self.seconds[list(run)].tolist()) for run in runs[:PLACES]
        )
        return Flaw(
            f"{self.name}: {what}",
            shown(places, len(runs)) or "all messages",
            **({"places": places} | more),
        )

    def around(self, rows: Rows, values: Floats, run: tuple[int, int], label: str) -> Plot:
        """Return the plot of a value of the messages `rows` around a run of messages."""
        margin = max(20, run[1] - run[0])
        near = np.flatnonzero((rows >= run[0] - margin) & (rows <= run[1] + margin))
        near = near[:: -(-len(near) // _SHOWN_POINTS) or 1]
        from_s, to_s = self.seconds[list(run)].tolist()
        x, y = self.seconds[rows[near]].tolist(), values[near].tolist()
        return Plot("seconds since the bag's beginning", label, x, y, [(from_s, to_s)])


def bag_flaws(
    bag: OpenBag, topics: Sequence[TopicOverview]
) -> tuple[list[Flaw], dict[str, Looked]]:
    """Return what is wrong with the topics of a bag, ranked, and how much of each was read."""
    start_ns = min((int(one.times_ns.min()) for one in topics if len(one.times_ns)), default=0)
    found, looked = list[Flaw](), dict[str, Looked]()
    for one in topics:
        info, times = one.info, _Times(one.info.name, one.times_ns, one.recordings, start_ns)
        found += _time_flaws(times)
        if info.problem or info.count < _FEWEST:
            continue
        try:
            flaws, looked[info.name] = _contents(bag, info, times)
            found += flaws
        # A camera may need a package that is missing, or have an encoding that is not known.
        except (LogError, UsageError) as error:
            what = f"{info.name}: its messages cannot be compared"
            found.append(
                Flaw(what, "all messages", str(error), severity="note", kind="not compared")
            )
    return ranked(found), looked


def topic_flaws(name: str, times_ns: Rows, recordings: Rows) -> list[Flaw]:
    """Return what is wrong with the times of a topic of a bag.

    Topics without a steady rate, such as events, are not evaluated: half of the intervals
    must be within a tenth of the median.

    Args:
        name: Name of the topic.
        times_ns: (N,) log_time of each message, in the order of recording.
        recordings: (N,) index of the recording of each message.
    """
    return _time_flaws(_Times(name, times_ns, recordings, int(times_ns.min(initial=2**62))))


def _time_flaws(times: _Times) -> list[Flaw]:
    """Return what is wrong with the times of a topic; see `topic_flaws`."""
    intervals_s = np.diff(times.times_ns) / NS_PER_S
    inside = np.diff(times.recordings) == 0
    ahead = intervals_s[inside & (intervals_s > 0)]
    if len(ahead) < 10:
        return []
    usual_s = float(np.median(ahead))
    jitter = robust_spread(ahead) / usual_s
    back = inside & (intervals_s < -usual_s)
    steady = float((np.abs(ahead - usual_s) <= JITTER * usual_s).mean()) >= 0.5
    drops = inside & (intervals_s > DROP * usual_s) & steady
    lost = int(np.rint(intervals_s[drops] / usual_s - 1).sum())
    found = []
    for kind, flags, what, figure, unit, share, todo in (
        (
            "clock",
            back,
            f"the time goes back {int(back.sum())} times",
            -float(intervals_s.min(initial=0.0)),
            "s",
            float(back.mean()),
            "take other times (`time: header` in the mapping), or split the bag there",
        ),
        (
            "drops",
            drops,
            f"about {counted(lost, 'message')} are missing at {1 / usual_s:.3g} Hz",
            float(lost),
            "messages",
            lost / (len(times.times_ns) + lost),
            "record with less load, or with a larger queue",
        ),
    ):
        runs = [(row, row) for row in np.flatnonzero(flags).tolist()]
        if runs:
            rows, worst = np.arange(len(intervals_s)), int(np.abs(intervals_s * flags).argmax())
            plot = times.around(rows, intervals_s, (worst, worst), _INTERVAL)
            more = {"figure": figure, "unit": unit, "share": share, "next": todo, "plot": plot}
            found.append(times.flaw(runs, what, kind=kind, **more))
    if steady and jitter > JITTER:
        found.append(_jitter(times, ahead, usual_s, jitter))
    return found


def _jitter(times: _Times, ahead_s: Floats, usual_s: float, jitter: float) -> Flaw:
    counts, edges = np.histogram(ahead_s, 30)
    return times.flaw(
        [],
        f"the intervals vary by {jitter:.0%} of {usual_s:.4g} s",
        next="take a fixed rate: `clock.rate_hz` in the mapping",
        kind="jitter",
        figure=jitter,
        unit="of the median",
        share=float((np.abs(ahead_s - usual_s) > JITTER * usual_s).mean()),
        plot=Plot(_INTERVAL, "messages", edges[:-1].tolist(), counts.tolist(), is_bars=True),
    )


class _Compared(NamedTuple):
    """Messages that were compared.

    Attributes:
        rows: (K,) indexes of the messages, ascending.
        joined: (K,) whether a message follows the one before it in the bag, in its recording.
        same: (K,) whether it has the same content, too.
        contents: (K,) hash of the content; empty for frames of videos.
        sizes: (K,) size of the message, bytes; empty for frames of videos.
    """

    rows: Rows
    joined: Flags
    same: Flags
    contents: Rows
    sizes: Rows

    @classmethod
    def of(cls, times: _Times, rows: Rows, same: Flags, *more: Rows) -> _Compared:
        """Return messages of which `same` are like the one before them."""
        joined = (np.diff(rows, prepend=-2) == 1) & (
            np.diff(times.recordings[rows], prepend=-1) == 0
        )
        empty = np.empty(0, np.int64)
        return cls(rows, joined, same & joined, *(more or (empty, empty)))

    def runs(self, flags: Flags, least: int = 1) -> list[tuple[int, int]]:
        """Return first and last index of runs of at least `least` flags."""
        at = np.flatnonzero(flags)
        parts = np.split(at, np.flatnonzero((np.diff(at) > 1) | ~self.joined[at[1:]]) + 1)
        return [(int(part[0]), int(part[-1])) for part in parts if len(part) >= max(1, least)]

    def places(self, runs: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
        """Return first and last message of runs."""
        return [(int(self.rows[first]), int(self.rows[last])) for first, last in runs]


_Values = Callable[[Rows], tuple[Rows, Floats]]
"""Function that returns the rows (R,) that can be read of those given, and values (R, G, E): E
elements, such as pixels, in each of G groups, of which the mean change counts."""


def _contents(bag: OpenBag, info: TopicInfo, times: _Times) -> tuple[list[Flaw], Looked]:
    """Return the flaws of the contents of a topic, and how much of it was read."""
    if kind_of(info) not in IMAGES:
        compared = _compared(times, *_hashes(bag, info))
        looked = Looked(info.count, len(compared.rows))
        return [*_repeated(times, compared, _numbers(bag, info), looked)], looked
    camera = _Camera(bag, info)
    compared = _frames(camera, times) if camera.is_video else _compared(times, *_hashes(bag, info))
    blank = camera.blank(compared)
    shown_blank = compared.runs(blank)
    compared = compared._replace(same=compared.same & ~blank)
    found = [*_repeated(times, compared, camera.values, None)]
    looked = Looked(info.count, len(compared.rows), len(camera.ranges))
    return [*_black(times, compared, camera, shown_blank), *found], looked


def _spread(count: int, most: int, blocks: int) -> Rows:
    """Return at most `most` of `count` rows, in blocks that are spread evenly."""
    if count <= most:
        return np.arange(count)
    starts = np.linspace(0, count - most // blocks, blocks).astype(np.int64)
    return np.unique(starts[:, None] + np.arange(most // blocks))


def _hashes(bag: OpenBag, info: TopicInfo) -> tuple[Rows, Rows, Rows]:
    """Return rows (K,), hashes of the contents (K,) and sizes (K,) of the messages compared."""
    skipped = _size_of_stamp(info)
    first = [len(data) for _, data in bag.payloads(info.name, np.arange(min(8, info.count)))]
    size = max(1, *first, 1)
    most = min(_MESSAGES if skipped is not None else _MESSAGES // 10, _BYTES // size)
    rows = _spread(info.count, max(most, _FRAMES), _BLOCKS)
    found: Iterable[tuple[int, int, int]]
    if skipped is None:
        part = max(1, min(1000, _READ // size))
        parts = (rows[k : k + part] for k in range(0, len(rows), part))
        found = ((row, one, size) for part in parts for row, one in _decoded(bag, info, part))
    else:
        payloads = bag.payloads(info.name, rows)
        found = ((row, hash(data[skipped:]), len(data)) for row, data in payloads)
    table = np.array(sorted(found), np.int64).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2]


def _ticks(path: str, kind: str = "") -> bool:
    """Return whether a field is a stamp or counts messages."""
    names = {name.removesuffix("[]") for name in path.split(".")}
    return kind.startswith("time") or bool(names & _TICKING)


def _size_of_stamp(info: TopicInfo) -> int | None:
    """Return the size of what precedes the content in the bytes of a message.

    It is None if a message must be decoded, because it has stamps or counters elsewhere.
    """
    ticking = [path for path, kind in info.fields.items() if _ticks(path, kind)]
    if not ticking:
        return 0
    names = list(info.fields)
    is_ros1, has_number = info.encoding == "ros1", names[0].endswith("seq")
    first = names[1 if is_ros1 and has_number and len(names) > 1 else 0]
    is_leading = info.fields[first] == "time" and all(
        path.startswith(first) or path == names[0] for path in ticking
    )
    if not is_leading or info.encoding not in ("cdr", "ros1"):
        return None
    # 4 bytes of CDR name its byte order, or are the sequence number; a time has 8.
    return 12 if has_number or not is_ros1 else 8


def _decoded(bag: OpenBag, info: TopicInfo, rows: Rows) -> Iterator[tuple[int, int]]:
    """Yield row and hash of the fields of messages, without stamps and counters."""
    paths = [
        path
        for path, kind in info.fields.items()
        if not _ticks(path, kind)
        and (kind.partition("[")[0].rstrip("0123456789") in (*NUMBERS, "string", "bytes"))
    ]
    found = bag.read(info.name, paths, rows)
    columns = [found.columns[path] for path in paths]
    for k, row in enumerate(found.rows.tolist()):
        yield row, hash(tuple(_bytes(column[k]) for column in columns))


def _bytes(value: Any) -> Any:
    """Return what can be hashed of a value."""
    if isinstance(value, np.ndarray):
        return value.tobytes() if value.dtype != object else tuple(map(_bytes, value))
    return tuple(map(_bytes, value)) if isinstance(value, list | tuple) else repr(value)


def _compared(times: _Times, rows: Rows, contents: Rows, sizes: Rows) -> _Compared:
    same = np.diff(contents, prepend=0) == 0
    return _Compared.of(times, rows, same, contents, sizes)


def _numbers(bag: OpenBag, info: TopicInfo) -> _Values:
    """Return the function that reads the numbers of messages: groups of one element."""
    kinds = {path: kind.removesuffix("[]" * path.count("[]")) for path, kind in info.fields.items()}
    every = [
        path
        for path, kind in kinds.items()
        if not _ticks(path, kind) and (kind in NUMBER_KINDS or kind.partition("[")[0] in ELEMENTS)
    ]
    # Of a list of messages, the first is read if there is nothing else.
    flat = [path for path in every if "[]" not in path]
    paths = flat or [path.replace("[]", "[0]") for path in every]

    def read(rows: Rows) -> tuple[Rows, Floats]:
        known, parts = list[int](), dict[str, list[Floats]]()
        for row in np.array_split(rows, -(-len(rows) // _BLOCKS)):
            found = bag.read(info.name, paths, row)
            known += found.rows.tolist()
            for path in paths:
                table = found.columns[path].reshape(len(found.rows), -1)
                if table.dtype != object:
                    chosen = np.linspace(0, table.shape[1] - 1, min(table.shape[1], _COLUMNS))
                    part = table[:, chosen.astype(int)].astype(np.float64)
                    parts.setdefault(path, []).append(part)
        tables = [
            np.concatenate(each)
            for each in parts.values()
            if sum(map(len, each)) == len(known) and len({part.shape[1] for part in each}) == 1
        ]
        table = np.concatenate([np.empty((len(known), 0)), *tables], axis=1)
        table = np.where(np.isfinite(table), table, 0.0)
        table = table[:, np.ptp(table, axis=0) > 0] if len(table) else table
        chosen = np.linspace(0, table.shape[1] - 1, min(table.shape[1], _COLUMNS)).astype(int)
        return np.array(known, np.int64), table[:, chosen, np.newaxis]

    return read


class _Camera:
    """Small copies of the frames of a topic that were decoded.

    Attributes:
        is_video: Whether the messages are packets of a video.
        ranges: Range of the pixels of each decoded frame, by its row; 255 is the full range.
    """

    def __init__(self, bag: OpenBag, info: TopicInfo) -> None:
        quantity = Quantity.model_validate({"image": info.name, "resize": _THUMBNAIL})
        self._reader = ImageReader(bag, info.name, quantity)
        self.is_video = self._reader.packets_ns is not None
        self._count, self._frames = info.count, dict[int, NDArray[np.float32]]()
        self.ranges: dict[int, float] = {}
        self._has_codes = True

    def load(self, rows: Rows) -> None:
        """Decode frames that are not known."""
        lacking = np.array([row for row in rows.tolist() if row not in self._frames], np.int64)
        for row, image in self._reader.images(lacking) if len(lacking) else ():
            self._has_codes &= image.dtype == np.uint8
            self._frames[row] = image.astype(np.float32).ravel()
        if not self._frames:
            raise LogError("; ".join(map(str, self._reader.problems())))
        ranges = {row: float(np.ptp(image)) for row, image in self._frames.items()}
        scale = 1.0 if self._has_codes else 255 / max([*ranges.values(), 1e-12])
        self.ranges = {row: each * scale for row, each in ranges.items()}

    def values(self, rows: Rows) -> tuple[Rows, Floats]:
        """Return rows (R,) and pixels (R, 1, E)."""
        self.load(rows)
        known = [row for row in rows.tolist() if row in self._frames]
        frames = [self._frames[row][np.newaxis].astype(np.float64) for row in known]
        if len({frame.shape for frame in frames}) != 1:
            return np.empty(0, np.int64), np.empty((0, 1, 1))
        return np.array(known, np.int64), np.array(frames)

    def blank(self, compared: _Compared) -> Flags:
        """Return (K,) whether frames are of one color, as far as some of them were decoded.

        Those are spread evenly, or have the smallest messages, as compressed black frames do.
        """
        rows = compared.rows
        chosen = rows[_spread(len(rows), _FRAMES - _FRAMES // 5, _FRAMES // 5)]
        if len(compared.sizes) > _FRAMES:
            smallest = np.argsort(compared.sizes, kind="stable")[: _FRAMES // 5]
            chosen = np.union1d(chosen, rows[smallest])
        self.load(chosen)
        known = np.array(sorted(self.ranges), np.int64)
        ranges = np.array([self.ranges[row] for row in known.tolist()])
        dark = ranges <= DARK
        if not dark.any() or (not dark.all() and np.median(ranges[~dark]) <= 5 * DARK):
            return np.zeros(len(rows), bool)
        at = np.searchsorted(rows, known[dark])
        flags = np.zeros(len(rows), bool)
        flags[at] = True
        if len(compared.contents):
            flags |= np.isin(compared.contents, compared.contents[at])
        return flags


def _frames(camera: _Camera, times: _Times) -> _Compared:
    """Compare the frames of a video, by their small copies."""
    rows, values = camera.values(_spread(len(times.times_ns), _FRAMES, _FRAMES // 50))
    same = np.abs(np.diff(values, axis=0, prepend=np.inf)).max((1, 2), initial=0) <= _LOSS
    return _Compared.of(times, rows, same)


def _black(
    times: _Times, compared: _Compared, camera: _Camera, runs: Sequence[tuple[int, int]]
) -> Iterator[Flaw]:
    if not runs:
        return
    rows = np.array(sorted(camera.ranges), np.int64)
    ranges = np.array([camera.ranges[row] for row in rows.tolist()])
    count = sum(last - first + 1 for first, last in runs)
    places = compared.places(runs)
    yield times.flaw(
        places,
        f"{counted(count, 'frame')} are of one color",
        effect=f"{len(rows)} of {len(times.times_ns)} frames were decoded",
        kind="black",
        figure=float(ranges.min()),
        unit="range of the pixels",
        share=count / len(compared.rows),
        next="check exposure, lens cap and cable, and leave this time out",
        plot=times.around(rows, ranges, longest(places), "range of the pixels"),
    )


def _repeated(
    times: _Times, compared: _Compared, values: _Values, looked: Looked | None
) -> Iterator[Flaw]:
    """Find contents that are sent again and again; without `looked`, they are frames."""
    what, kind = ("content", "repeated") if looked is not None else ("frame", "frozen")
    rows, same = compared.rows, compared.same
    more: dict[str, Any] = {
        "kind": kind,
        "unit": "messages",
        "effect": f"{len(rows)} of {counted(len(times.times_ns), 'message')} were compared,"
        " without stamps",
    }
    starts = np.flatnonzero(~same)
    repeats = np.arange(len(rows)) - starts[np.cumsum(~same) - 1] if len(starts) else rows
    label = "repetitions so far"
    if regular := _regular(compared):
        run = (int(rows[0]), int(rows[min(len(rows), 20 * int(regular)) - 1]))
        yield times.flaw(
            [],
            f"each {what} is sent {regular:g} times in a row",
            severity="note",
            figure=regular,
            share=float(same.mean()),
            next="the sensor is slower than its topic: take a clock that is as slow"
            " (`clock.rate_hz` in the mapping)",
            plot=times.around(rows, repeats.astype(np.float64), run, label),
            **more,
        )
        return
    runs = compared.runs(same, HELD)
    held = sum(last - first + 1 for first, last in runs)
    if not runs or len(rows) - held < _FEWEST or not is_usual(same, runs):
        return
    if len(compared.contents):
        _, of, counts = np.unique(compared.contents, return_inverse=True, return_counts=True)
        runs = [run for run in runs if counts[of[run[0]]] == run[1] - run[0] + 2]
    runs = sorted(sorted(runs, key=lambda run: run[0] - run[1])[:_SUSPECTS])
    motion = _Motion(compared, runs, values)
    if runs := [run for run in runs if motion.is_fault(*run)]:
        places = compared.places(runs)
        worst = longest(places)
        count = worst[1] - worst[0] + 1
        yield times.flaw(
            places,
            f"the same {what} is sent again up to {count} times, but changes in nearly all other"
            " messages",
            figure=float(count),
            share=sum(last - first + 1 for first, last in runs) / len(rows),
            next="check the driver, which repeats its last value, and leave this time out",
            plot=times.around(rows, repeats.astype(np.float64), worst, label),
            **more,
        )


def _regular(compared: _Compared) -> float:
    """Return how often each content is sent in a row, if it is at least twice, and always so."""
    starts = np.flatnonzero(~compared.same)
    if len(starts) < 12:
        return 0.0
    whole = compared.joined[starts[:-1]] & compared.joined[starts[1:]]
    lengths = np.diff(starts)[whole]
    usual = float(np.median(lengths)) if len(lengths) >= 10 else 0.0
    near = np.abs(lengths - usual) <= (0 if usual < 4 else max(1.0, 0.1 * usual))
    if usual < 2 or near.mean() < _REGULAR:
        return 0.0
    # What alternates between few contents is a state, not the value of a sensor.
    contents = compared.contents[starts] if len(compared.contents) else starts
    return usual if len(np.unique(contents)) > _LIVELY * len(starts) else 0.0


class _Motion:
    """How the values of a topic change, usually and beside runs of repeated messages."""

    def __init__(
        self, compared: _Compared, runs: Sequence[tuple[int, int]], values: _Values
    ) -> None:
        count = len(compared.rows)
        inside = np.zeros(count, bool)
        for first, last in runs:
            inside[first - 1 : last + 1] = True
        beside = [k for first, _ in runs for k in range(first - 3, first)]
        beside += [k for _, last in runs for k in range(last, last + 4)]
        wanted = np.unique([*_spread(count, 240, 60).tolist(), *beside]).astype(np.int64)
        known, found = values(compared.rows[wanted[(wanted >= 0) & (wanted < count)]])
        order = np.argsort(known)
        at, self._values = np.searchsorted(compared.rows, known[order]), found[order]
        self._place = {row: k for k, row in enumerate(at.tolist())}
        # Noise is never the same twice, but what stops now and then is.
        self._is_restless = compared.same[~inside].mean() <= _STRAY
        self._joined, self._outside = compared.joined, self._values[~inside[at]]
        single, double = (
            [
                change
                for row in self._place
                if not inside[row : row + steps + 1].any()
                and (change := self.change(row, steps)) is not None
            ]
            for steps in (1, 2)
        )
        self._is_enough = len(single) >= _FEWEST // 2 and len(double) >= _FEWEST // 4
        if self._is_enough:
            self._typical = _median(single)
            self._is_rough = _median(double) < _ROUGH * self._typical

    def change(self, row: int, steps: int = 1) -> Floats | None:
        """Return the changes (G,) from a message to a later one, if all between them were read."""
        rows = range(row, row + steps + 1)
        if not all(one in self._place for one in rows) or not self._joined[rows[1:]].all():
            return None
        first, last = (self._values[self._place[one]] for one in (row, row + steps))
        change: Floats = np.abs(last - first).mean(-1)
        return change

    def is_fault(self, first: int, last: int) -> bool:
        """Return whether a run is not that of something at rest; see the module."""
        if not self._is_enough or last not in self._place:
            return False
        typical, held = self._typical, self._values[self._place[last]]
        is_noise = self._is_rough & self._is_restless
        earlier, before, after, later, latest = map(
            self.change, (first - 3, first - 2, last, last + 1, last + 2)
        )
        moves = [each for each in (earlier, before, later, latest) if each is not None]
        # What is set in steps, as commands are, does not change in each message before and after.
        usable = np.all([typical > 0, *(each > 0 for each in moves)], axis=0)
        if held.shape[1] == 1:
            value, others = held[:, 0], self._outside[:, :, 0]
            usable &= (value != 0) & ~(others == value).any(0)
            is_noise = is_noise & (value > others.min(0)) & (value < others.max(0))
        ends = [each for each in (before, after) if each is not None]
        noise = usable & is_noise
        if noise.any() and ends and min((e[noise] / typical[noise]).mean() for e in ends) > _ABRUPT:
            return True
        speeds = [each for each in (before, later) if each is not None]
        if after is None or not speeds:
            return False
        smooth = usable & ~self._is_rough
        speed, steps = np.max(speeds, axis=0), last - first + 2
        # A jump that is larger than what was missed is a reset, or a new estimate of the position.
        jumps = (after >= _JUMP * speed) & (after >= typical) & (after <= _JUMP * steps * speed)
        if before is not None:
            jumps &= before >= _ABRUPT * typical
        return bool(smooth.any() and jumps[smooth].mean() >= 0.5)


def _median(changes: Sequence[Floats]) -> Floats:
    """Return the median (G,) of changes (G,) that are not 0; 0 if there are none."""
    parts = [column[column > 0] for column in np.array(changes).T]
    return np.array([np.median(part) if len(part) else 0.0 for part in parts])
