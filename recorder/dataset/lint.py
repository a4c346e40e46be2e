"""Checks for problems in a dataset that can harm learning."""

from __future__ import annotations

import functools
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from hashlib import sha256
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.actions import MASK_KEY, JointActions, allowed_actions, joint_actions
from mcaprl.errors import Problem
from mcaprl.recorder.dataset.arrays import is_beyond_float32
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.images import blocks_of
from mcaprl.recorder.dataset.statistics import calibration
from mcaprl.recorder.dataset.transitions import Episode
from mcaprl.recorder.format.behavior import LOG_DENSITY
from mcaprl.recorder.format.spaces import (
    Leaf,
    bounds_of,
    observation_leaves,
    outside,
    part_names,
)

GAP: Final = 1.5
"""Shortest reported gap between two steps, as a multiple of the median time between steps."""
_SHOWN = 3
_note = functools.partial(Problem, severity="note")


def lint(dataset: Dataset) -> list[Problem]:
    """Return the findings of all checks: first the problems, then the notes."""
    found = [finding for check in _CHECKS for finding in check(dataset)]
    return sorted(found, key=lambda finding: finding.severity != "problem")


def _not_finite(dataset: Dataset) -> Iterator[Problem]:
    effect = (
        "one NaN or infinite value in a batch makes every weight NaN; training rejects the dataset"
    )
    counts = {name: c.not_finite for name, c in dataset.statistics.observations.items()}
    for leaf in leaves_of(dataset):
        if counts[leaf.name]:
            places = _places(dataset, functools.partial(_bad_frames, leaf))
            what = f"{counts[leaf.name]} values of {leaf.name} are NaN or infinite"
            yield Problem(what, places, effect)
    bad = int((~np.isfinite(dataset.rewards)).sum())
    if bad:
        places = _places(dataset, lambda episode: ~np.isfinite(episode.rewards))
        yield Problem(f"{bad} rewards are NaN or infinite", places, effect)
    beyond = is_beyond_float32(dataset.rewards)
    if beyond.any():
        yield Problem(
            f"{_count(int(beyond.sum()), 'reward')} beyond float32, such as"
            f" {dataset.rewards[beyond][0]:g}",
            _places(dataset, lambda episode: is_beyond_float32(episode.rewards)),
            "training rejects the dataset",
        )


def _out_of_range(dataset: Dataset) -> Iterator[Problem]:
    for leaf in leaves_of(dataset):
        bounds = bounds_of(leaf.of(dataset.observation_space))
        if bounds is None or leaf.encoding is not None:
            continue
        column = dataset.statistics.observations[leaf.name]
        low, high = (bound.reshape(-1) for bound in bounds)
        wrong = np.flatnonzero((column.low < low) | (column.high > high))
        if len(wrong):
            first = int(wrong[0])
            yield Problem(
                f"values of {_count(len(wrong), 'element')} of {leaf.name} are outside its space",
                f"{element_name(dataset, leaf, first)} has values from {column.low[first]:.4g} to"
                f" {column.high[first]:.4g}, but bounds {low[first]:.4g} to {high[first]:.4g}",
                "training rejects values outside of discrete spaces, and observations that are"
                " scaled by the bounds of the space are out of range",
            )


def _impossible_actions(dataset: Dataset) -> Iterator[Problem]:
    space, effect = dataset.action_space, "training rejects the dataset"
    if isinstance(space, spaces.Box):
        parts = zip(action_parts(dataset), space.low.flat, space.high.flat, strict=True)
        for number, (name, low, high) in enumerate(parts):
            is_bad = functools.partial(_is_beyond, number, low, high)
            count = int(is_bad(dataset).sum())
            if count:
                what = f"{name} is not in [{low:.4g}, {high:.4g}] in {_steps(dataset, count)}"
                yield Problem(what, _places(dataset, is_bad), effect)
        return
    wrong = outside(dataset.action_space, dataset.actions)
    if wrong.any():
        yield Problem(
            f"{_count(int(wrong.sum()), 'action')} outside of {dataset.action_space}",
            _places(dataset, lambda episode: outside(dataset.action_space, episode.actions)),
            effect,
        )


def _is_beyond(number: int, low: float, high: float, data: Dataset | Episode) -> NDArray[np.bool_]:
    """Mark the actions (T,) with a part that is out of its bounds or not finite."""
    part = data.actions.reshape(len(data.actions), -1)[:, number]
    found: NDArray[np.bool_] = ~((part >= low) & (part <= high) & np.isfinite(part))
    return found


def _constant_parts(dataset: Dataset) -> Iterator[Problem]:
    if len(dataset) < 2 or not isinstance(dataset.action_space, spaces.Box):
        return
    parts = dataset.actions.reshape(len(dataset), -1)
    same = np.flatnonzero((parts == parts[0]).all(0))
    if len(same):
        names = [
            f"{action_parts(dataset)[index]} is {parts[0, index]:.4g}" for index in same[:_SHOWN]
        ]
        yield Problem(
            f"{_count(len(same), 'part')} of the action never change",
            ", ".join(names) + (", ..." if len(same) > _SHOWN else ""),
            "training rejects the dataset: nothing can be learned about a command that is constant",
        )


def _masked_actions(dataset: Dataset) -> Iterator[Problem]:
    joint = joint_actions(dataset.action_space)
    masks = [leaf for leaf in leaves_of(dataset) if leaf.path == (MASK_KEY,)]
    if joint is None or not masks or masks[0].shape != (joint.count,):
        return
    forbidden = [_is_forbidden(joint, episode) for episode in dataset.episodes]
    count = sum(int(one.sum()) for one in forbidden)
    if count:
        yield Problem(
            f"{_count(count, 'action')} that the log's own {MASK_KEY} forbids",
            _places(dataset, functools.partial(_is_forbidden, joint)),
            "training rejects the dataset",
        )


def _is_forbidden(joint: JointActions, episode: Episode) -> NDArray[np.bool_]:
    """Mark the actions (T,) in their space that the mask of their observation forbids."""
    allowed = allowed_actions(episode.observations)
    assert allowed is not None, "the observations have a mask"
    inside = joint.contain(episode.actions)
    forbidden = np.zeros(len(inside), bool)
    chosen = joint.indexes(np.asarray(episode.actions)[inside])
    forbidden[inside] = ~allowed[np.flatnonzero(inside), chosen]
    return forbidden


def _constant(dataset: Dataset) -> Iterator[Problem]:
    if len(dataset) < 2:
        return
    for leaf in leaves_of(dataset):
        column = dataset.statistics.observations[leaf.name]
        same = np.flatnonzero(column.low == column.high)
        if len(same):
            names = ", ".join(element_name(dataset, leaf, int(index)) for index in same[:_SHOWN])
            yield _note(
                f"{_count(len(same), 'element')} of {leaf.name} never change",
                names + (", ..." if len(same) > _SHOWN else ""),
                "constant elements carry no information, and the network is untrained for other"
                " values",
            )


def _duplicates(dataset: Dataset) -> Iterator[Problem]:
    copies = [indexes for indexes in digests(dataset).values() if len(indexes) > 1]
    if copies:
        extra = sum(len(indexes) - 1 for indexes in copies)
        yield Problem(
            f"{_count(extra, 'episode')} are duplicates of others",
            "; ".join(listed(indexes) for indexes in copies[:_SHOWN]),
            "duplicate episodes are overweighted, and held-out episodes can also be in the training"
            " data",
        )


def digests(dataset: Dataset) -> dict[bytes, list[int]]:
    """Return the indexes of the episodes by a digest of observations, actions and rewards."""
    alike: dict[bytes, list[int]] = defaultdict(list)
    for episode in dataset.episodes:
        digest = sha256()
        for part in (*_arrays(episode.observations), episode.actions, episode.rewards):
            for block in blocks_of(part):
                digest.update(block.data)
        alike[digest.digest()].append(episode.index)
    return alike


def _actions_never_taken(dataset: Dataset) -> Iterator[Problem]:
    space = dataset.action_space
    if not isinstance(space, spaces.Discrete) or not dataset.statistics.action_counts:
        return
    every = range(int(space.start), int(space.start + space.n))
    missing = [action for action in every if action not in dataset.statistics.action_counts]
    if missing:
        names = [dataset.action_names.get(action, str(action)) for action in missing[:_SHOWN]]
        yield _note(
            f"{_count(len(missing), 'action')} of {int(space.n)} were never taken",
            ", ".join(names) + (", ..." if len(missing) > _SHOWN else ""),
            "Q-values of actions that were never taken are extrapolated: choose an algorithm that"
            " stays close to the behavior policy (cql, bcq, bc)",
        )


def _rewards(dataset: Dataset) -> Iterator[Problem]:
    rewards = dataset.rewards
    if len(rewards) and not rewards.any():
        yield Problem("every reward is 0", "all steps", "there is no learning signal")
        return
    last = np.zeros(len(rewards), dtype=bool)
    last[np.cumsum(dataset.statistics.lengths) - 1] = True
    if not rewards[~last].any():
        yield _note(
            "only the last steps of episodes have a reward",
            f"{int((rewards != 0).sum())} of {len(dataset.episodes)} episodes",
            "training propagates final rewards to early steps slowly: n-step returns help",
        )
        return
    cut, others = rewards[dataset.truncated & ~dataset.terminated], rewards[~last]
    if len(cut) and len(others):
        beyond = (cut < others.min()) | (cut > others.max())
        if beyond.any():
            yield Problem(
                f"{_count(int(beyond.sum()), 'truncated episode')} end with a reward that no"
                " other step has",
                f"{cut[beyond][0]:.4g}; other steps have {others.min():.4g} to {others.max():.4g}",
                "learners bootstrap after truncation, but this reward suggests a terminal state",
            )


def _time_gaps(dataset: Dataset) -> Iterator[Problem]:
    pauses = [np.diff(episode.log_time_ns) for episode in dataset.episodes]
    if not pauses:
        return
    usual_ns = float(np.median(np.concatenate(pauses)))
    gaps = [
        (index, int(step), int(pause[step]))
        for index, pause in enumerate(pauses)
        for step in np.flatnonzero(pause > GAP * usual_ns)
    ]
    if gaps:
        index, step, longest_ns = max(gaps, key=lambda gap: gap[2])
        yield Problem(
            f"{_count(len(gaps), 'gap')} in time; the median step is {usual_ns / 1e9:.4g} s",
            f"the longest is {longest_ns / 1e9:.4g} s, episode {index} step {step}",
            "steps are missing or took longer: these transitions cover more time than others",
        )


def _mixed_policies(dataset: Dataset) -> Iterator[Problem]:
    policies = Counter(episode.policy or "unknown" for episode in dataset.episodes)
    if len(policies) > 1:
        found = [f"{count} by {name}" for name, count in policies.most_common()]
        more = [f"and {len(found) - _SHOWN} more"] if len(found) > _SHOWN else []
        yield _note(
            f"{len(policies)} behavior policies",
            "; ".join(found[:_SHOWN] + more),
            "behavior cloning learns a mixture of these policies",
        )


def _unknown_probabilities(dataset: Dataset) -> Iterator[Problem]:
    unknown, field = int(np.isnan(dataset.behavior).sum()), dataset.behavior_field
    if unknown:
        way = "" if field == LOG_DENSITY else " without `estimate_behavior=True`"
        yield _note(
            f"{field.name} is unknown in {_steps(dataset, unknown)}",
            _places(dataset, lambda episode: np.isnan(episode.behavior)),
            f"off-policy evaluation by importance sampling is not possible{way}",
        )
    elif dataset.has_estimated_probs:
        yield _note(
            f"{field.name} is estimated",
            "all steps",
            "intervals of off-policy estimates do not include the error of estimated probabilities",
        )


def _impossible_probabilities(dataset: Dataset) -> Iterator[Problem]:
    field = dataset.behavior_field
    impossible = int(field.is_impossible(dataset.behavior).sum())
    if impossible:
        yield Problem(
            f"{field.name} is not {field.expected} in {_steps(dataset, impossible)}",
            _places(dataset, lambda episode: field.is_impossible(episode.behavior)),
            "off-policy evaluation by importance sampling is not possible",
        )


def _wrong_probabilities(dataset: Dataset) -> Iterator[Problem]:
    found = calibration(dataset.behavior, dataset.action_space)
    if found is not None and not found.possible:
        yield Problem(
            f"behavior_prob implies {found}",
            "all steps",
            "off-policy estimates, which are weighted by behavior_prob, are biased",
        )


_CHECKS: Final[tuple[Callable[[Dataset], Iterator[Problem]], ...]] = (
    _not_finite,
    _out_of_range,
    _impossible_actions,
    _constant_parts,
    _masked_actions,
    _duplicates,
    _time_gaps,
    _rewards,
    _constant,
    _actions_never_taken,
    _mixed_policies,
    _unknown_probabilities,
    _impossible_probabilities,
    _wrong_probabilities,
)


def leaves_of(dataset: Dataset) -> tuple[Leaf, ...]:
    """Return the leaves of the observation space."""
    return observation_leaves(dataset.observation_space)


def _bad_frames(leaf: Leaf, episode: Episode) -> NDArray[np.bool_]:
    """Mark the values (T + 1, *shape) of an episode's observations that are not finite."""
    bad: NDArray[np.bool_] = ~np.isfinite(frames_of(leaf, episode))
    return bad


def frames_of(leaf: Leaf, episode: Episode) -> NDArray[Any]:
    """Return the values (T + 1, *shape) of a leaf in an episode's observations."""
    last = leaf.of(episode.next_observations)[-1:]
    return np.concatenate([leaf.of(episode.observations), last])


def element_name(dataset: Dataset, leaf: Leaf, index: int) -> str:
    """Return the name of one element of a leaf."""
    names = dataset.observation_names
    return names[index] if len(names) == leaf.size else f"{leaf.name}[{index}]"


def _arrays(observations: Any) -> list[NDArray[Any]]:
    if isinstance(observations, dict):
        return [array for part in observations.values() for array in _arrays(part)]
    return [observations]


def _places(dataset: Dataset, flags: Callable[[Episode], NDArray[np.bool_]]) -> str:
    """Format the first steps at which `flags` returns a true value."""
    found: list[str] = []
    for episode in dataset.episodes:
        bad = flags(episode)
        steps = np.flatnonzero(bad.reshape(len(bad), -1).any(1))[:_SHOWN]
        found += [f"episode {episode.index} step {step}" for step in steps]
        if len(found) >= _SHOWN:
            break
    return ", ".join(found[:_SHOWN])


def action_parts(dataset: Dataset) -> tuple[str, ...]:
    """Return the names of the parts of the action."""
    return part_names(dataset.action_space, dataset.action_part_names)


def _steps(dataset: Dataset, count: int) -> str:
    return f"{count} of {_count(len(dataset), 'step')}"


def listed(indexes: list[int]) -> str:
    """Return the first indexes of episodes as text."""
    more = f" and {len(indexes) - _SHOWN} more" if len(indexes) > _SHOWN else ""
    return f"episodes {', '.join(map(str, indexes[:_SHOWN]))}{more}"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number != 1 else ''}"
