"""What is wrong with the data itself: faults of sensors, clocks and recording, with their times.

Where `lint` asks what training needs, this module compares a dataset with itself. Its limits are
quantiles and separations of the data, and docs/howto/quality.md has their rates of errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import Problem
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.lint import (
    action_parts,
    digests,
    element_name,
    frames_of,
    leaves_of,
    listed,
)
from mcaprl.recorder.dataset.neighbors import nearest_rows
from mcaprl.recorder.format.spaces import Leaf
from mcaprl.texts import counted

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = NDArray[np.int64]

LAGS: Final = 8
"""Longest lag that is sought between a command and its effect, steps."""
NS_PER_S: Final = 1e9
SHOWN: Final = 3
PLACES: Final = 20
_IMAGE: Final = 256
_ELEMENTS: Final = 64
_ROWS: Final = 20_000
_KNOWN: Final = 4_000
_USUAL: Final = 0.95
"""Share of steps in which a value must change so that a pause of it is strange."""
HELD: Final = 5
_DEAD: Final = 10
DROP: Final = 1.75
JITTER: Final = 0.1
_CLOCK: Final = 20.0
DARK: Final = 4
_CLIPPED: Final = 0.2
_LEAK: Final = 0.95
_EFFECT: Final = 0.02
"""Smallest share of a change that a lag must explain to be reported."""
_LONE: Final = 15.0
_FEW: Final = 0.05
_APART: Final = 3.0
_INTERVAL: Final = "seconds until the next step"


def _range(noun: str, first: int, last: int, from_s: float, to_s: float) -> str:
    if first == last:
        return f"{noun} {first}, {from_s:.2f} s"
    return f"{noun}s {first} to {last}, {from_s:.2f} to {to_s:.2f} s"


class Place(NamedTuple):
    """Steps of an episode, both included, and their times since its beginning, seconds."""

    episode: int
    first: int
    last: int
    from_s: float
    to_s: float

    def __str__(self) -> str:
        """Return steps and times."""
        return f"episode {self.episode} {_range('step', *self[1:])}"


class TopicPlace(NamedTuple):
    """Messages of a topic, both included, and their times since the bag's beginning, seconds."""

    topic: str
    first: int
    last: int
    from_s: float
    to_s: float

    def __str__(self) -> str:
        """Return messages and times."""
        return _range("message", *self[1:])


class Plot(NamedTuple):
    """Curve of a finding: its points, and the ranges of x that are concerned."""

    x_label: str
    y_label: str
    x: Sequence[float]
    y: Sequence[float]
    spans: Sequence[tuple[float, float]] = ()
    is_bars: bool = False


@dataclass(frozen=True)
class Flaw(Problem):
    """Finding about the data.

    Attributes:
        kind: Kind of the finding, such as `frozen` or `lag`.
        share: Share of the data that is concerned: of steps, or of episodes or messages.
        figure: Number that decided, in `unit`.
        unit: Meaning of `figure`.
        places: First places, at most 20; empty if all of the data is concerned.
        plot: What the page of a report draws; None if there is nothing to draw.
    """

    kind: str = ""
    share: float = 0.0
    figure: float = 0.0
    unit: str = ""
    places: tuple[Place | TopicPlace, ...] = ()
    plot: Plot | None = None

    def to_json(self) -> dict[str, Any]:
        """Return what `info --quality --json` prints, without the plot."""
        found = asdict(self) | {"places": [place._asdict() for place in self.places]}
        del found["plot"]
        return found


def flaws(dataset: Dataset, test: Dataset | None = None) -> list[Flaw]:
    """Return what is wrong with the data: problems before notes, the most of the data first.

    Args:
        dataset: Data; of more than 20,000 steps, some checks take evenly spread ones.
        test: Data that is held out; its episodes must not be in `dataset`.
    """
    if not len(dataset):
        return []
    table = _Table(dataset)
    found = [flaw for check in _CHECKS for flaw in check(table)]
    return ranked([*found, *_duplicates(dataset, test)])


def ranked(found: Sequence[Flaw]) -> list[Flaw]:
    """Return problems before notes, and each by the share of the data."""
    return sorted(found, key=lambda flaw: (flaw.severity != "problem", -flaw.share))


class _Table:
    """The numbers of a dataset: frames (F, V), without images, and actions (N, A)."""

    def __init__(self, dataset: Dataset) -> None:
        self.dataset = dataset
        self.episodes = dataset.episodes
        self.images: list[Leaf] = []
        self.names: list[str] = []
        columns: list[NDArray[Any]] = []
        for leaf, frames in zip(leaves_of(dataset), _flat(dataset.frames), strict=True):
            if len(leaf.shape) > 1 and leaf.size >= _IMAGE:
                self.images.append(leaf)
            elif leaf.size <= _IMAGE * 4 and np.asarray(frames).dtype.kind in "biuf":
                columns.append(np.asarray(frames, np.float64).reshape(len(frames), -1))
                self.names += [element_name(dataset, leaf, k) for k in range(leaf.size)]
        self.frames: Floats = np.concatenate([np.empty((len(self), 0)), *columns], axis=1)
        self.frames = np.where(np.isfinite(self.frames), self.frames, 0.0)
        self.of_step = dataset.frame_of_step
        self.owner = np.repeat(np.arange(len(self.episodes)), dataset.episode_lengths)
        self.step = np.concatenate([np.arange(len(one)) for one in self.episodes])
        self.times_ns = np.concatenate([one.log_time_ns for one in self.episodes])
        self.intervals_ns = self.times_ns[self.of_step + 1] - self.times_ns[self.of_step]
        self.changes = self.frames[self.of_step + 1] - self.frames[self.of_step]

    def __len__(self) -> int:
        return len(self.dataset) + len(self.dataset.episode_lengths)

    def place(self, first: int, last: int) -> Place:
        """Return the place of two rows of steps in one episode."""
        start = self.times_ns[self.of_step[first] - self.step[first]]
        ends = self.times_ns[self.of_step[[first, last]]] - start
        from_s, to_s = (ends / NS_PER_S).tolist()
        index = self.episodes[self.owner[first]].index
        return Place(index, int(self.step[first]), int(self.step[last]), from_s, to_s)

    def runs(self, flags: Flags, least: int = 1) -> list[tuple[int, int]]:
        """Return first and last row of runs of at least `least` flags within episodes."""
        rows = np.flatnonzero(flags)
        if not len(rows):
            return []
        cuts = np.flatnonzero((np.diff(rows) > 1) | (np.diff(self.owner[rows]) > 0)) + 1
        parts = np.split(rows, cuts)
        return [(int(part[0]), int(part[-1])) for part in parts if len(part) >= least]

    def around(self, values: Floats, first: int, last: int, label: str) -> Plot:
        """Return the plot of a value of each step around a place."""
        margin = max(20, last - first)
        same = np.flatnonzero(self.owner == self.owner[first])
        low, high = max(same[0], first - margin), min(same[-1], last + margin)
        rows = np.arange(low, high + 1)
        span = (float(self.step[first]) - 0.5, float(self.step[last]) + 0.5)
        return Plot("step", label, self.step[rows].tolist(), values[rows].tolist(), [span])


def _flaw(table: _Table, runs: Sequence[tuple[int, int]], what: str, **more: Any) -> Flaw:
    """Return the flaw of some runs of steps."""
    places = tuple(table.place(*run) for run in runs[:PLACES])
    share = sum(last - first + 1 for first, last in runs) / len(table.dataset)
    return Flaw(
        what,
        shown(places, len(runs)) or "all steps",
        places=places,
        **{"share": share} | more,
    )


def shown(places: Sequence[Place | TopicPlace], count: int) -> str:
    """Return the first of `count` places as text."""
    rest = f" and {count - SHOWN} more" if count > SHOWN else ""
    return "; ".join(map(str, places[:SHOWN])) + rest


def longest(runs: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Return the longest of runs, given as first and last row."""
    return max(runs, key=lambda run: run[1] - run[0])


def _images(table: _Table) -> Iterator[Flaw]:
    for leaf in table.images:
        spread, still = [], []
        for episode in table.episodes:
            frames = np.asarray(frames_of(leaf, episode)).reshape(len(episode) + 1, -1)
            spread.append(np.ptp(frames.astype(np.float32), axis=1)[:-1])
            still.append((frames[1:] == frames[:-1]).all(1))
        ranges, same = np.concatenate(spread), np.concatenate(still)
        if leaf.dtype != np.uint8:
            # Depth has no codes: its largest range counts as the full one.
            ranges = ranges * (255 / max(float(ranges.max()), 1e-12))
        blank = ranges <= DARK
        if blank.all() or (blank.any() and np.median(ranges[~blank]) > 5 * DARK):
            runs = table.runs(blank)
            yield _flaw(
                table,
                runs,
                f"{counted(int(blank.sum()), 'frame')} of {leaf.name} are of one color",
                kind="black",
                figure=float(ranges.min()),
                unit="range of the pixels",
                next="check exposure, lens cap and cable, and leave these steps out:"
                " `Dataset.without`",
                plot=table.around(ranges, *longest(runs), "range of the pixels"),
            )
        same &= ~blank
        runs = table.runs(same, 2)
        if runs and is_usual(same, runs):
            yield _frozen(table, runs, f"frames of {leaf.name}", 1.0 - same, "1 if it changes")


def is_usual(same: Flags, runs: Sequence[tuple[int, int]]) -> bool:
    """Return whether the value changes in nearly all steps that are in no run."""
    held = sum(last - first + 1 for first, last in runs)
    return bool(same.sum() - held <= (1 - _USUAL) * (len(same) - held))


def _frozen(
    table: _Table, runs: Sequence[tuple[int, int]], name: str, values: Floats, label: str
) -> Flaw:
    worst = longest(runs)
    steps = worst[1] - worst[0] + 1
    return _flaw(
        table,
        runs,
        f"{name} stay the same for up to {counted(steps, 'step')}, but change in nearly all others",
        kind="frozen",
        figure=float(steps),
        unit="steps",
        next="check the driver and the time limit of the topic (`gap_s`), and leave these steps"
        " out: `Dataset.without`",
        plot=table.around(values, *worst, label),
    )


def _held(table: _Table) -> Iterator[Flaw]:
    """Find observations that are repeated while the others change."""
    moving = np.flatnonzero(np.ptp(table.frames, axis=0) > 0)
    if not len(moving) or len(table.dataset) < 20:
        return
    same = (table.changes[:, moving] == 0).all(1)
    size = np.abs(table.changes[:, moving] / table.frames[:, moving].std(0)).sum(1)
    runs = [
        run
        for run in table.runs(same, HELD)
        if _jumps(table, size, run) and _others_move(table, run)
    ]
    if runs and same.mean() <= 1 - _USUAL:
        label = "change, standard deviations"
        yield _frozen(table, runs, "all numbers of the observation", size, label)
    for k in moving:
        still = (table.changes[:, k] == 0) & ~same
        if still.mean() > 1 - _USUAL:
            continue
        values, size = table.frames[table.of_step, k], np.abs(table.changes[:, k])
        runs = [
            run
            for run in table.runs(still, _DEAD)
            if _jumps(table, size, run) and _is_unique(values, run)
        ]
        if runs:
            yield _frozen(table, runs, f"the values of {table.names[k]}", values, table.names[k])


def _others_move(table: _Table, run: tuple[int, int]) -> bool:
    """Return whether actions or rewards change inside a run, unlike those of a robot at rest."""
    rows = slice(run[0] + 1, run[1])
    others = (table.dataset.actions[rows], table.dataset.rewards[rows])
    return any(bool((part != part[0]).any()) for part in others)


def _is_unique(values: Floats, run: tuple[int, int]) -> bool:
    """Return whether a held value is nowhere else, as values at rest and at a limit are."""
    return int((values == values[run[0]]).sum()) <= run[1] - run[0] + 2


def _jumps(table: _Table, sizes: Floats, run: tuple[int, int]) -> bool:
    """Return whether a value that was held jumps afterwards, or is held to the episode's end."""
    after = run[1] + 1
    if after >= len(table.owner) or table.owner[after] != table.owner[run[0]]:
        return run[1] - run[0] + 1 >= _DEAD
    return bool(sizes[after] > 2 * np.median(sizes[sizes > 0]))


def _dead(table: _Table) -> Iterator[Flaw]:
    """Find values that are constant in few of the episodes."""
    stops = np.cumsum(table.dataset.episode_lengths + 1)
    long = np.flatnonzero(table.dataset.episode_lengths >= _DEAD)
    if len(long) < 5:
        return
    parts = [table.frames[stops[e] - len(table.episodes[e]) - 1 : stops[e]] for e in long]
    constant = np.array([np.ptp(part, axis=0) == 0 for part in parts])
    for k in np.flatnonzero(constant.any(0) & (constant.mean(0) <= 0.25)):
        dead = long[constant[:, k]]
        others = ~np.isin(table.owner, dead)
        here = table.frames[table.of_step, k]
        known = np.isin(here[~others], here[others]).any()
        if known or (table.changes[others, k] != 0).mean() < _USUAL:
            continue
        runs = table.runs(np.isin(table.owner, dead))
        yield _flaw(
            table,
            runs,
            f"{table.names[k]} is dead in {counted(len(dead), 'episode')}: constant there, but in"
            " no others",
            kind="dead",
            figure=float(len(dead)),
            unit="episodes",
            next="check this sensor or joint, and leave the episodes out: `mcaprl filter`",
            plot=Plot(
                "episode",
                f"range of {table.names[k]}",
                long.tolist(),
                [float(np.ptp(part[:, k])) for part in parts],
                [(float(e) - 0.5, float(e) + 0.5) for e in dead],
                is_bars=True,
            ),
        )


def _times(table: _Table) -> Iterator[Flaw]:
    intervals_s = table.intervals_ns / NS_PER_S
    usual_s = float(np.median(intervals_s))
    if usual_s <= 0 or len(intervals_s) < 10:
        return
    sizes = np.linalg.norm(table.changes / np.maximum(table.frames.std(0), 1e-12), axis=1)
    calm = sizes <= 3 * np.median(sizes)
    clock = (intervals_s < 0) | ((intervals_s > _CLOCK * usual_s) & calm & (sizes > 0))
    drops = ~clock & (intervals_s > DROP * usual_s)
    if clock.any():
        runs = table.runs(clock)
        worst = float(intervals_s[clock][np.abs(intervals_s[clock]).argmax()])
        yield _flaw(
            table,
            runs,
            f"the clock steps {len(runs)} times, by up to {worst:.4g} s, while the observations"
            " change as usual",
            kind="clock",
            figure=worst,
            unit="s",
            next="set the clock before recording, or take other times: `time` in the mapping",
            plot=table.around(intervals_s, *longest(runs), _INTERVAL),
        )
    if drops.any():
        runs = table.runs(drops)
        lost = int(np.rint(intervals_s[drops] / usual_s - 1).sum())
        yield _flaw(
            table,
            runs,
            f"about {counted(lost, 'step')} are missing; the median step is {usual_s:.4g} s",
            kind="drops",
            figure=float(lost),
            unit="steps",
            share=lost / (len(table.dataset) + lost),
            next="record with less load, or divide episodes at gaps: `gap_s` in the mapping",
            plot=table.around(intervals_s, *longest(runs), _INTERVAL),
        )
    yield from _jitter(intervals_s, usual_s, intervals_s[~clock & ~drops], table)


def _jitter(intervals_s: Floats, usual_s: float, rest: Floats, table: _Table) -> Iterator[Flaw]:
    jitter = robust_spread(rest) / usual_s
    if jitter > JITTER:
        far = np.abs(intervals_s - usual_s) > JITTER * usual_s
        counts, edges = np.histogram(rest, 30)
        yield _flaw(
            table,
            [],
            f"the time between steps varies by {jitter:.0%} (robust standard deviation); the median"
            f" is {usual_s:.4g} s",
            kind="jitter",
            figure=float(jitter),
            unit="of the median",
            share=float(far.mean()),
            next="take a fixed rate: `clock.rate_hz` in the mapping",
            plot=Plot(_INTERVAL, "steps", edges[:-1].tolist(), counts.tolist(), is_bars=True),
        )


def robust_spread(values: Floats) -> float:
    """Return the median absolute deviation in the scale of a standard deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if len(values) else 0.0


def _saturated(table: _Table) -> Iterator[Flaw]:
    space = table.dataset.action_space
    if not isinstance(space, spaces.Box):
        return
    actions = table.dataset.actions.reshape(len(table.dataset), -1)
    for k, name in enumerate(action_parts(table.dataset)):
        part = actions[:, k]
        if len(np.unique(part)) < 20:
            continue
        for end, bound in ((part.min(), space.low.flat[k]), (part.max(), space.high.flat[k])):
            at = part == end
            if at.mean() < _CLIPPED:
                continue
            inside = bool(np.isfinite(bound)) and not np.isclose(end, bound)
            runs = table.runs(at)
            yield _flaw(
                table,
                runs,
                f"{name} is {end:.4g} in {at.mean():.0%} of the steps"
                + (f", and never reaches its bound {bound:.4g}" if inside else ""),
                kind="saturated",
                figure=float(at.mean()),
                unit="of the steps",
                severity="problem" if inside else "note",
                next="check the limits of the controller"
                if inside
                else "unless this is bang-bang control, widen the limits of the controller",
                plot=table.around(part.astype(np.float64), *longest(runs), name),
            )


def _leaks(table: _Table) -> Iterator[Flaw]:
    """Find parts of the observation that are the action of the same step.

    Steps that repeat the last action prove nothing: there, the last action is equal too.
    """
    dataset = table.dataset
    actions = dataset.actions.reshape(len(dataset), -1).astype(np.float64)
    now = table.frames[table.of_step]
    new = np.flatnonzero((table.step[1:] > 0) & (actions[1:] != actions[:-1]).any(1)) + 1
    names = ["the action"] if actions.shape[1] == 1 else list(action_parts(dataset))
    for k in range(actions.shape[1]):
        rows = new[actions[new, k] != actions[new - 1, k]]
        if len(rows) < 20:
            continue
        limit = 1e-5 * max(float(np.ptp(actions[:, k])), 1e-12)
        equal = np.abs(now[rows] - actions[rows, k, None]) <= limit
        for e in np.flatnonzero(equal.mean(0) >= _LEAK):
            shown = rows[:100]
            yield _flaw(
                table,
                [],
                f"{table.names[e]} is {names[k]} of the same step in {equal[:, e].mean():.0%} of"
                " the steps with a new action",
                kind="leak",
                figure=float(equal[:, e].mean()),
                unit="of the steps with a new action",
                share=1.0,
                effect="a policy learns to copy it, and has nothing to copy when it drives",
                next="leave it out of the observation, or take its last value before the action",
                plot=Plot(
                    f"{names[k]}",
                    table.names[e],
                    actions[shown, k].tolist(),
                    now[shown, e].tolist(),
                ),
            )


def _lag(table: _Table) -> Iterator[Flaw]:
    """Find by how many steps the effects of actions are late.

    The change of each observed value is explained by the observation and the actions of this and
    the last steps together. The effect of a lag is the part of the variance that its actions alone
    explain (squared partial correlation), so that actions that resemble the last ones do no harm.
    """
    found = effect_by_lag(table)
    if found is None:
        return
    effects, chance = found
    best = int(effects.argmax())
    plot = Plot(
        "lag, steps",
        "share of the change",
        list(range(len(effects))),
        effects.tolist(),
        [(best - 0.5, best + 0.5)],
        is_bars=True,
    )
    if effects[best] < chance:
        yield _flaw(
            table,
            [],
            f"actions do not cause what follows: they explain {effects[best]:.2%} of any change",
            kind="no effect",
            figure=float(effects[best]),
            unit="of the change",
            share=1.0,
            next="check that these are the commands that the robot obeys, and their times",
            plot=plot,
        )
    elif best > 0 and effects[best] > max(3 * effects[0], _EFFECT):
        seconds = best * float(np.median(table.intervals_ns)) / NS_PER_S
        yield _flaw(
            table,
            [],
            f"actions have their largest effect {counted(best, 'step')} later ({seconds:.3g} s)",
            kind="lag",
            figure=float(best),
            unit="steps",
            share=1.0,
            effect="a policy that sees no earlier actions cannot know what is still to happen",
            next="check the times of commands and sensors (`time: header` in the mapping), or stack"
            " frames",
            plot=plot,
        )


def effect_by_lag(table: _Table) -> tuple[Floats, float] | None:
    """Return the effect of the actions (LAGS + 1,) by their lag, and the largest one by chance.

    The latter is the tail bound of a chi-square (Laurent and Massart 2000) over all that is tried.
    None if the data are too few.
    """
    dataset, moving = table.dataset, np.flatnonzero(np.ptp(table.frames, axis=0) > 0)[:_ELEMENTS]
    actions = _coded(dataset)
    rows = np.flatnonzero(table.step >= LAGS)
    width = (LAGS + 1) * actions.shape[1] + len(moving) + 1
    if not len(moving) or not actions.shape[1] or len(rows) < max(200, 5 * width):
        return None
    rows = rows[:: -(-len(rows) // _ROWS)]
    state = table.frames[table.of_step[rows]][:, moving]
    state = (state - state.mean(0)) / np.maximum(state.std(0), 1e-12)
    blocks = [actions[rows - lag] for lag in range(LAGS + 1)]
    change = table.changes[rows][:, moving]
    change = _clipped(change[:, np.ptp(change, axis=0) > 0])
    every = _unexplained(change, [state, *blocks])
    effects = []
    for lag in range(LAGS + 1):
        without = _unexplained(change, [state, *blocks[:lag], *blocks[lag + 1 :]])
        # Of values that are explained anyway, nothing is left to explain.
        known = without > 1e-6 * len(rows)
        effects.append(float(((without - every)[known] / without[known]).max(initial=0.0)))
    count, tail = actions.shape[1], float(np.log(1000 * change.shape[1] * len(effects)))
    chance = (count + 2 * np.sqrt(count * tail) + 2 * tail) / (len(rows) - width)
    return np.array(effects), float(chance)


def _clipped(change: Floats) -> Floats:
    """Clip each column at its quantiles, so that resets and jumps do not decide; scale it."""
    low, high = np.quantile(change, [0.01, 0.99], axis=0)
    change = np.clip(change, low, high)
    change = change[:, change.std(0) > 0]
    scaled: Floats = (change - change.mean(0)) / change.std(0)
    return scaled


def _coded(dataset: Dataset) -> Floats:
    """Return the actions as numbers: one column for each value of a Discrete but the first."""
    actions = dataset.actions.reshape(len(dataset), -1)
    if isinstance(dataset.action_space, spaces.Box):
        varied = actions[:, np.ptp(actions, axis=0) > 0]
        return varied.astype(np.float64)
    values = [np.unique(column)[1:33] for column in actions.T]
    parts = [column[:, None] == own for column, own in zip(actions.T, values, strict=True)]
    return np.concatenate(parts, axis=1).astype(np.float64)


def _unexplained(change: Floats, parts: Sequence[Floats]) -> Floats:
    """Return the sum of squares (V,) of each column that a linear model leaves."""
    known = np.column_stack([np.ones(len(change)), *parts])
    basis, sizes, _ = np.linalg.svd(known, full_matrices=False)
    basis = basis[:, sizes > 1e-9 * sizes[0]]
    left: Floats = np.square(change - basis @ (basis.T @ change)).sum(0)
    return left


def _outliers(table: _Table) -> Iterator[Flaw]:
    statistics = table.dataset.statistics
    returns, lengths = statistics.returns, statistics.lengths.astype(np.float64)
    apart = {
        "return": (_apart(returns, abs(float(np.median(returns)))), returns),
        "length": (_apart(np.log10(lengths), 1.0), lengths),
    }
    for name, (far, values) in apart.items():
        if not len(far):
            continue
        worst = far[np.abs(values[far] - np.median(values)).argmax()]
        yield _flaw(
            table,
            table.runs(np.isin(table.owner, far)),
            f"the {name} of {counted(len(far), 'episode')} is far from all others, such as"
            f" {values[worst]:.4g}; the median is {np.median(values):.4g}",
            kind=name,
            figure=float(values[worst]),
            unit=name,
            share=len(far) / len(values),
            next="look at these episodes (`mcaprl replay`), and leave them out: `mcaprl filter`",
            plot=Plot(
                "episode",
                name,
                list(range(len(values))),
                values.tolist(),
                [(float(e) - 0.5, float(e) + 0.5) for e in far],
                is_bars=True,
            ),
        )


def _apart(values: Floats, least: float) -> Rows:
    """Return the few values that are farther from the rest than the rest is wide."""
    order = np.argsort(values, kind="stable")
    for count in range(int(_FEW * len(values)), 0, -1):
        for far, rest in ((order[:count], order[count:]), (order[-count:], order[:-count])):
            gap = max(
                values[rest].min() - values[far].max(), values[far].min() - values[rest].max()
            )
            if gap > max(_APART * np.ptp(values[rest]), least):
                return far
    return np.empty(0, np.int64)


def _lonely(table: _Table) -> Iterator[Flaw]:
    """Find states that are far from all states of other episodes."""
    states = table.frames[table.of_step]
    if len(table.episodes) < 5 or not states.shape[1] or len(states) < 200:
        return
    low, high = np.quantile(states, [0.01, 0.99], axis=0)
    wide = np.where(high > low, high - low, np.maximum(np.ptp(states, axis=0), 1e-12))
    states = (states - low) / wide
    asked = np.arange(0, len(states), -(-len(states) // _ROWS))
    known = np.arange(0, len(states), -(-len(states) // _KNOWN))
    _, far = nearest_rows(states[asked], states[known], table.owner[asked], table.owner[known])
    limit = _LONE * float(np.quantile(far, 0.99))
    lone = far > limit
    if not lone.any() or limit <= 0:
        return
    flags = np.zeros(len(states), bool)
    flags[asked[lone]] = True
    curve = np.sort(far)[::-1][:200]
    runs = table.runs(flags)
    yield _flaw(
        table,
        runs,
        f"{counted(int(lone.sum()), 'state')} have no neighbors in other episodes: the distance is"
        f" {far.max() / np.median(far):.3g} times the median",
        kind="lonely",
        figure=float(far.max() / np.median(far)),
        unit="times the median distance",
        next="look for broken values there; what is learned from them holds nowhere else",
        plot=Plot(
            "state, by distance",
            "distance to the nearest state",
            list(range(len(curve))),
            curve.tolist(),
            [(-0.5, float(lone.sum()) - 0.5)],
            is_bars=True,
        ),
    )


def _duplicates(dataset: Dataset, test: Dataset | None) -> Iterator[Flaw]:
    own = digests(dataset)
    extra = [index for indexes in own.values() for index in indexes[1:]]
    if extra:
        yield _copied(dataset, extra, f"{counted(len(extra), 'episode')} are duplicates of others")
    if test is not None:
        held = digests(test)
        both = sorted(index for digest in own.keys() & held for index in own[digest])
        if both:
            also = listed(sorted(index for digest in own.keys() & held for index in held[digest]))
            what = f"{counted(len(both), 'episode')} are also in the test data, as {also}"
            yield _copied(dataset, both, what)


def _copied(dataset: Dataset, indexes: list[int], what: str) -> Flaw:
    copies = set(indexes)
    flags = [float(episode.index in copies) for episode in dataset.episodes]
    return Flaw(
        what,
        listed(indexes),
        "they count more than once, and results on held-out data are too good",
        "leave them out: `mcaprl filter`",
        kind="duplicates",
        share=len(copies) / len(flags),
        figure=float(len(copies)),
        unit="episodes",
        places=tuple(
            Place(one.index, 0, len(one) - 1, 0.0, float(np.ptp(one.log_time_ns)) / NS_PER_S)
            for one in dataset.episodes
            if one.index in copies
        )[:PLACES],
        plot=Plot("episode", "copy", list(range(len(flags))), flags, is_bars=True),
    )


_CHECKS: Final[tuple[Callable[[_Table], Iterator[Flaw]], ...]] = (
    _images,
    _held,
    _dead,
    _times,
    _saturated,
    _leaks,
    _lag,
    _outliers,
    _lonely,
)


def _flat(frames: Any) -> list[Any]:
    if isinstance(frames, dict):
        return [array for part in frames.values() for array in _flat(part)]
    return [frames]
