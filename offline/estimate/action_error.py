"""Errors of a policy's actions in logged states, beside three baselines.

The error of a part of a Box action is its absolute difference from the logged command, in the
command's unit; that of a discrete part is 1 if it differs, otherwise 0. The total error is the mean
over the parts, each divided by its standard deviation in the log. A chunk of H actions at step t is
compared with the logged actions at t to t + H - 1, as far as the episode goes.

Baselines: the last logged command before the step, the mean command of the reference episodes (of
discrete parts: the most frequent value), and the command at the nearest logged state of the
reference episodes, with the actions that followed it. The reference is the training episodes, or
all other episodes. Intervals are percentiles of 2,000 resamples of the episodes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import PolicyError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.neighbors import nearest_rows, states_of
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.recorder.format.spaces import part_names

Floats = NDArray[np.float64]
MAX_STEPS: Final = 10_000
"""Number of compared steps, and of reference states, above which whole episodes are left out."""
MAX_HORIZON: Final = 1_000
BASELINES: Final = ("repeat", "mean", "nearest")
WORST_S: Final = 10.0
_RESAMPLES: Final = 2_000
_SHOWN_STATE: Final = 6


@dataclass
class Actor:
    """What is compared."""

    name: str
    # Function of an episode that returns actions (T, *shape) or chunks (T, H, *shape). A step that
    # has no action is NaN.
    actions: Callable[[Episode], Any]
    # Function that selects the action of one step of an episode, for its latency; None if the
    # actions were computed elsewhere.
    call: Callable[[Episode, int], Any] | None = None
    # Function of an episode that returns the log probabilities (T,) of its actions.
    log_probs: Callable[[Episode], NDArray[np.floating[Any]]] | None = None
    compared: Sequence[int] | None = None  # Numbers of the episodes to compare; None for all
    trained_on: Sequence[int] | None = None  # Numbers of the reference episodes; None for all
    why: str = "all episodes"  # Why these episodes are compared


@dataclass(frozen=True)
class Error:
    """Mean error of one part of the action, or of all parts.

    Attributes:
        part: Name of the part; `all parts` for the total.
        unit: Unit; `sd` for standard deviations of the log, empty if unknown.
        mean: Mean error of the policy's first action.
        interval: 95 % interval of that mean; None with fewer than two episodes.
        baselines: Mean error of each baseline.
        change: Mean absolute change from step to step of the policy's commands.
        logged_change: The same of the logged commands.
        by_horizon: Mean error of each of the H actions of a chunk.
        horizon_intervals: Their intervals.
    """

    part: str
    unit: str
    mean: float
    interval: tuple[float, float] | None
    baselines: dict[str, float]
    change: float
    logged_change: float
    by_horizon: list[float]
    horizon_intervals: list[tuple[float, float] | None] = field(default_factory=list)


@dataclass(frozen=True)
class Worst:
    """Where the total error is largest.

    Attributes:
        episode: Index of the episode.
        step: Step of the largest error.
        time_s: Its time since the start of the episode.
        error: Total error of this step, standard deviations.
        state: First numbers of its observation by name.
        first: First step of the ten seconds with the largest mean error, of all episodes.
        last: Step after the last one of these.
        window_episode: Episode of these ten seconds.
    """

    episode: int
    step: int
    time_s: float
    error: float
    state: dict[str, float]
    window_episode: int
    first: int
    last: int


@dataclass(frozen=True)
class ActionError:
    """Errors of one policy's actions in the states of a log; see the module.

    Attributes:
        policy: Name of the policy.
        episodes: Number of compared episodes.
        why: Why these episodes.
        steps: Number of compared steps.
        horizon: Number H of actions of a chunk.
        total: Error of all parts.
        parts: Error of each part.
        log_loss: Mean negative log probability of the logged discrete actions; None if unknown.
        agreement: Share of steps whose whole discrete action is the logged one; None for a Box.
        worst: Where the total error is largest.
        latency_ms: 50 % and 99 % quantile of the time of one call; None if not measured.
        missed: Share of the timed calls that took longer than the period of the log.
        period_ms: Median time between two steps of the log.
        beside: Whether the total error is `below`, `above` or `as large as` that of the best
            baseline, by the interval of their difference over the episodes; empty if there is a
            single episode.
        window: Times (s), commands and logged commands (n, parts) of the worst ten seconds.
    """

    policy: str
    episodes: int
    why: str
    steps: int
    horizon: int
    total: Error
    parts: tuple[Error, ...]
    log_loss: float | None
    agreement: float | None
    worst: Worst
    latency_ms: tuple[float, float] | None
    missed: float | None
    period_ms: float
    beside: str
    window: tuple[Floats, Floats, Floats] = field(repr=False)

    def lines(self) -> list[str]:
        """Return the lines below the table of the errors."""
        worst = self.worst
        best = min(self.total.baselines, key=lambda name: self.total.baselines[name])
        state = ", ".join(f"{name} {value:.3g}" for name, value in worst.state.items())
        beside = f"total error {self.beside} the best baseline's, {best}"
        found = [
            beside if self.beside else f"a single episode: not compared with {best}",
            f"worst: episode {worst.episode} at {worst.time_s:.2f} s (step {worst.step}),"
            f" {worst.error:.2f} sd{f': {state}' if state else ''}",
        ]
        if self.agreement is not None:
            loss = "" if self.log_loss is None else f", log-loss {self.log_loss:.3f}"
            found.append(f"agreement {self.agreement:.1%}{loss}")
        if self.latency_ms is not None and self.missed is not None:
            fast, slow = self.latency_ms
            late = f"; {self.missed:.1%} miss the log's period of {self.period_ms:.3g} ms"
            late = late if self.period_ms > 0 else "; the log has no times"
            found.append(f"latency p50 {fast:.3g} ms, p99 {slow:.3g} ms a call{late}")
        return found

    def to_json(self) -> dict[str, Any]:
        """Return the attributes without `window`, as JSON types."""
        found = {name: value for name, value in vars(self).items() if name != "window"}
        plain = {"total": vars(self.total), "parts": [vars(one) for one in self.parts]}
        return {**found, **plain, "worst": vars(self.worst)}


def as_chunks(actions: Any, count: int, shape: tuple[int, ...], who: str) -> NDArray[Any]:
    """Return actions (T, *shape) or chunks (T, H, *shape) as chunks."""
    try:
        found = np.asarray(actions)
    except ValueError as error:
        raise PolicyError(f"{who} returns chunks of different lengths") from error
    if found.dtype.kind not in "biuf":
        raise PolicyError(f"{who} returns {found.dtype}, but actions are numbers")
    if found.shape == (count, *shape):
        found = found[:, None]
    chunked = found.ndim == len(shape) + 2 and found.shape[:1] + found.shape[2:] == (count, *shape)
    if not chunked or not 1 <= found.shape[1] <= MAX_HORIZON:
        raise PolicyError(
            f"{who} returns shape {found.shape}, expected {(count, *shape)}, or"
            f" {(count, 'H', *shape)} with chunks of at most {MAX_HORIZON} actions"
        )
    return found


def compare(dataset: Dataset, actor: Actor, seed: int = 0) -> ActionError:
    """Compute the errors of a policy's actions in at most `MAX_STEPS` steps of whole episodes."""
    rng = np.random.default_rng(seed)
    wanted = range(len(dataset.episodes)) if actor.compared is None else actor.compared
    compared = _few(dataset, wanted, rng)
    drawn = f", of which {len(compared)} were drawn" if len(compared) < len(wanted) else ""
    chunks, horizon = predicted(dataset, actor, compared)
    found = _Errors(dataset, compared, chunks, horizon)
    reference = range(len(dataset.episodes)) if actor.trained_on is None else actor.trained_on
    for name, guess in _baselines(
        dataset, compared, reference, horizon, is_box=found.is_box, rng=rng
    ).items():
        found.add(name, [guess[number] for number in compared])
    if not any(np.isfinite(one[:, 0]).any() for one in found.errors["policy"]):
        raise PolicyError(f"{actor.name} has no action at a compared step of an episode")
    draws = rng.multinomial(
        len(compared), np.full(len(compared), 1 / len(compared)), size=_RESAMPLES
    )
    whole, parts = found.all_parts(draws)
    totals = [found.total(one[:, 0]) for one in found.errors["policy"]]
    worst, window = _worst(dataset, compared, totals, found.own, found.logged)
    pauses = [np.diff(dataset.episodes[number].log_time_ns) for number in compared]
    period_ms = float(np.median(np.concatenate(pauses))) / 1e6
    calls = _latencies(dataset, compared, actor)
    flags = np.concatenate(totals)
    return ActionError(
        actor.name,
        len(compared),
        actor.why + drawn,
        sum(int(np.isfinite(one).sum()) for one in totals),
        horizon,
        whole,
        parts,
        None if found.is_box else _log_loss(dataset, compared, actor),
        None if found.is_box else float((flags[np.isfinite(flags)] == 0).mean()),
        worst,
        None if calls is None else tuple(np.quantile(calls, (0.5, 0.99)).tolist()),
        None if calls is None or period_ms <= 0 else float((calls > period_ms).mean()),
        period_ms,
        found.beside(whole, draws),
        window,
    )


def predicted(
    dataset: Dataset, actor: Actor, compared: Sequence[int]
) -> tuple[list[NDArray[Any]], int]:
    """Return the chunks (T, H, *shape) of each episode, and H."""
    space, shape = dataset.action_space, tuple(dataset.action_space.shape or ())
    chunks = []
    for episode in (dataset.episodes[number] for number in compared):
        chunks.append(as_chunks(actor.actions(episode), len(episode), shape, actor.name))
        if not isinstance(space, spaces.Box):
            _check_whole(chunks[-1], actor.name)
    horizons = {found.shape[1] for found in chunks}
    if len(horizons) > 1:
        raise PolicyError(f"{actor.name} has chunks of different lengths")
    return chunks, horizons.pop()


class _Errors:
    """Errors (T, H, parts) of a policy and of the baselines by episode; NaN beyond its end."""

    def __init__(
        self, dataset: Dataset, compared: Sequence[int], chunks: list[NDArray[Any]], horizon: int
    ) -> None:
        """Compute the errors of the policy."""
        space, everything = dataset.action_space, _rows(dataset.actions)
        self.is_box, self._horizon = isinstance(space, spaces.Box), horizon
        scale = everything.std(0) if self.is_box else np.ones(everything.shape[1])
        self._scale = np.where(scale > 0, scale, 1.0)
        self.own = [_first(chunk) for chunk in chunks]
        self.logged = [_rows(dataset.episodes[number].actions) for number in compared]
        self._truth = [_ahead(rows, horizon) for rows in self.logged]
        self._known = [
            chunk.reshape(len(chunk), horizon, -1).astype(np.float64) for chunk in chunks
        ]
        self.errors: dict[str, list[Floats]] = {}
        self.add("policy", self._known)
        self._names = part_names(space, dataset.action_part_names)
        units = dataset.action_units
        self._units = units if len(units) == len(self._names) else ("",) * len(self._names)

    def add(self, name: str, guesses: Sequence[Floats]) -> None:
        """Compute the errors of actions (T, H, parts) at the steps that the policy has."""
        self.errors[name] = []
        for guess, truth, own in zip(guesses, self._truth, self._known, strict=True):
            difference = np.where(np.isnan(own), np.nan, np.abs(guess - truth))
            self.errors[name].append(difference if self.is_box else _differs(difference))

    def total(self, values: Floats) -> Floats:
        """Return the mean (T,) of the parts (T, n), in standard deviations of the log."""
        found: Floats = (values / self._scale).mean(1)
        return found

    def all_parts(self, draws: NDArray[np.int64]) -> tuple[Error, tuple[Error, ...]]:
        """Return the error of all parts, and of each part."""
        whole = self._error("all parts", "sd" if self.is_box else "", self.total, draws)
        return whole, tuple(
            self._error(name, unit, lambda values, k=k: values[:, k], draws)  # type: ignore[misc]
            for k, (name, unit) in enumerate(zip(self._names, self._units, strict=True))
        )

    def beside(self, whole: Error, draws: NDArray[np.int64]) -> str:
        """Compare the total error with that of the best baseline; see `ActionError`."""
        best = min(whole.baselines, key=lambda name: whole.baselines[name])
        pairs = zip(self.errors["policy"], self.errors[best], strict=True)
        _, interval = _mean(
            [self.total(own[:, 0]) - self.total(other[:, 0]) for own, other in pairs], draws
        )
        if interval is None:
            return ""
        return "below" if interval[1] < 0 else "above" if interval[0] > 0 else "as large as"

    def _error(
        self, name: str, unit: str, reduce: Callable[[Floats], Floats], draws: NDArray[np.int64]
    ) -> Error:
        def mean(which: str, step: int) -> tuple[float, tuple[float, float] | None]:
            return _mean([reduce(one[:, step]) for one in self.errors[which]], draws)

        steps = [mean("policy", step) for step in range(self._horizon)]
        others = {
            which: mean(which, 0)[0]
            for which in BASELINES
            if any(np.isfinite(one[:, 0]).any() for one in self.errors[which])
        }
        own, log = (
            _mean([reduce(_change(one, is_box=self.is_box)) for one in rows], draws)[0]
            for rows in (self.own, self.logged)
        )
        means, intervals = [one[0] for one in steps], [one[1] for one in steps]
        return Error(name, unit, means[0], intervals[0], others, own, log, means, intervals)


def _few(dataset: Dataset, wanted: Sequence[int], rng: np.random.Generator) -> list[int]:
    """Draw whole episodes of at most `MAX_STEPS` steps, but at least one."""
    lengths = dataset.episode_lengths
    order = rng.permutation(np.array(wanted, np.int64))
    fits = np.cumsum(lengths[order]) <= MAX_STEPS
    fits[0] = True
    return sorted(order[fits].tolist())


def _check_whole(chunks: NDArray[Any], who: str) -> None:
    known = chunks[np.isfinite(chunks)] if chunks.dtype.kind == "f" else chunks
    if (known != np.round(known)).any():
        raise PolicyError(f"{who} returns fractions, but the actions of the log are integers")


def _rows(actions: NDArray[Any]) -> Floats:
    return np.asarray(actions, np.float64).reshape(len(actions), -1)


def _first(chunks: NDArray[Any]) -> Floats:
    return _rows(chunks[:, 0])


def _differs(difference: Floats) -> Floats:
    return np.where(np.isnan(difference), np.nan, difference != 0)


def _change(rows: Floats, *, is_box: bool) -> Floats:
    change = np.abs(np.diff(rows, axis=0))
    return change if is_box else _differs(change)


def _ahead(rows: Floats, horizon: int) -> Floats:
    """Return the actions (T, H, n) at each step and the following ones; NaN beyond the end."""
    padded = np.concatenate([rows, np.full((horizon - 1, rows.shape[1]), np.nan)])
    windows = np.lib.stride_tricks.sliding_window_view(padded, horizon, axis=0)
    return np.moveaxis(windows, 2, 1)


def _mean(
    values: Sequence[Floats], draws: NDArray[np.int64]
) -> tuple[float, tuple[float, float] | None]:
    """Return the mean of all finite values of the episodes, and its bootstrap interval."""
    sums = np.array([np.nansum(one) for one in values])
    counts = np.array([np.isfinite(one).sum() for one in values], np.float64)
    if not counts.sum():
        return float("nan"), None
    drawn = draws @ counts
    interval = None
    if (counts > 0).sum() > 1:
        means = (draws @ sums)[drawn > 0] / drawn[drawn > 0]
        low, high = np.quantile(means, (0.025, 0.975)).tolist()
        interval = (low, high)
    return float(sums.sum() / counts.sum()), interval


def _baselines(
    dataset: Dataset,
    compared: Sequence[int],
    reference: Sequence[int],
    horizon: int,
    *,
    is_box: bool,
    rng: np.random.Generator,
) -> dict[str, dict[int, Floats]]:
    """Return the actions (T, H, n) of each baseline by episode."""
    found: dict[str, dict[int, Floats]] = {name: {} for name in BASELINES}
    used = _few(dataset, reference, rng)
    actions = {number: _rows(dataset.episodes[number].actions) for number in used}
    known = np.concatenate([states_of(dataset, dataset.episodes[number]) for number in used])
    groups = np.repeat(used, [len(actions[number]) for number in used])
    ahead = np.concatenate([_ahead(actions[number], horizon) for number in used])
    # The last action of an episode is used for those after its end.
    for step in range(1, horizon):
        gone = np.isnan(ahead[:, step])
        ahead[:, step][gone] = ahead[:, step - 1][gone]
    for number in compared:
        episode = dataset.episodes[number]
        rows, shape = _rows(episode.actions), (len(episode), horizon, ahead.shape[2])
        others = ahead[:, 0][groups != number]
        if not len(others):
            # A log of one episode has no other commands.
            for name in ("mean", "nearest"):
                found[name][number] = np.full(shape, np.nan)
            usual = rows[0]
        else:
            usual = others.mean(0) if is_box else _most_frequent(others)
            found["mean"][number] = np.broadcast_to(usual, shape)
            states = states_of(dataset, episode)
            near, _ = nearest_rows(states, known, np.full(len(states), number), groups)
            found["nearest"][number] = ahead[near]
        last = np.concatenate([usual[None], rows[:-1]])
        found["repeat"][number] = np.broadcast_to(last[:, None], shape)
    return found


def _most_frequent(rows: Floats) -> Floats:
    columns = [np.unique(column, return_counts=True) for column in rows.T]
    return np.array([values[counts.argmax()] for values, counts in columns])


def _worst(
    dataset: Dataset,
    compared: Sequence[int],
    totals: Sequence[Floats],
    own: Sequence[Floats],
    logged: Sequence[Floats],
) -> tuple[Worst, tuple[Floats, Floats, Floats]]:
    peaks = [np.nanmax(one) if np.isfinite(one).any() else -1.0 for one in totals]
    k = int(np.argmax(peaks))
    episode, step = dataset.episodes[compared[k]], int(np.nanargmax(totals[k]))
    best = (-1.0, 0, 0, 1)
    for place, one in enumerate(totals):
        seconds = _seconds(dataset.episodes[compared[place]])
        ends = np.searchsorted(seconds[:-1], seconds[:-1] + WORST_S)
        full = np.arange(len(ends))[seconds[:-1] + WORST_S <= seconds[-1]]
        sums = np.concatenate([[0.0], np.cumsum(np.nan_to_num(one))])
        for start in full if len(full) else [0]:
            stop = int(ends[start])
            mean = (sums[stop] - sums[start]) / max(stop - start, 1)
            best = max(best, (mean, place, int(start), stop))
    _, place, first, last = best
    state = {}
    names = dataset.observation_names
    values = states_of(dataset, episode)[step]
    for index, value in enumerate(values[:_SHOWN_STATE] if len(names) == len(values) else ()):
        state[names[index]] = float(value)
    worst = Worst(
        episode.index,
        step,
        float(_seconds(episode)[step]),
        float(peaks[k]),
        state,
        compared[place],
        first,
        last,
    )
    rows = slice(first, last)
    times = _seconds(dataset.episodes[compared[place]])[rows]
    return worst, (times, own[place][rows], logged[place][rows])


def _seconds(episode: Episode) -> Floats:
    """Return the times (T + 1,) since the start of an episode; steps if the log has no times."""
    seconds = (episode.log_time_ns - episode.log_time_ns[0]) / 1e9
    return seconds if seconds[-1] > 0 else np.arange(len(seconds), dtype=np.float64)


_TIMED: Final = 300


def _latencies(dataset: Dataset, compared: Sequence[int], actor: Actor) -> Floats | None:
    """Return the times (ms) of single calls, after three that are not counted."""
    if actor.call is None:
        return None
    found: list[float] = []
    for number in compared:
        for step in range(len(dataset.episodes[number])):
            began = time.perf_counter()
            actor.call(dataset.episodes[number], step)
            found.append((time.perf_counter() - began) * 1e3)
            if len(found) == _TIMED + 3:
                return np.array(found[3:])
    return np.array(found[3:] or found)


def _log_loss(dataset: Dataset, compared: Sequence[int], actor: Actor) -> float | None:
    if actor.log_probs is None:
        return None
    try:
        found = [actor.log_probs(dataset.episodes[number]) for number in compared]
    except PolicyError:
        return None
    loss = -float(np.concatenate(found).mean())
    # A greedy policy has the probabilities 0 and 1.
    return loss if np.isfinite(loss) else None
