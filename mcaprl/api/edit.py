"""Logs made of parts of other logs, with all their topics, metadata and attachments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mcaprl.api.action_errors import actors_of, is_foreign
from mcaprl.api.environments import sim_of
from mcaprl.api.policies import Names, as_names, policy_names, trained_policies
from mcaprl.api.ranges import check_fraction
from mcaprl.errors import UsageError
from mcaprl.files import check_log_name, check_target, temporary_folder
from mcaprl.progress import ProgressBar, no_progress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.labels import (
    Labels,
    carry_labels,
    change_labels,
    changes_in,
    labels_of,
    labels_to_carry,
)
from mcaprl.recorder.edit.join import merge_logs
from mcaprl.recorder.edit.piece import (
    Bounds,
    Edited,
    filter_log,
    relabeled,
    selected,
    slice_log,
    split_log,
)
from mcaprl.recorder.source import (
    Definitions,
    MappingFile,
    Paths,
    Source,
    labeled_recording,
    open_data,
    opened,
)
from mcaprl.recorder.viewer.annotate import Verification, annotated_copy, values_topics
from mcaprl.storage.remote import as_path, is_url


def merge(data: Paths, out: str | Path, *, shift: bool = False, overwrite: bool = False) -> Edited:
    """Join logs into one log.

    The episodes of the new log are in the order of their times. The logs must be finished, and have
    the same spaces, environment, names of observations and actions, and step duration. Other
    metadata fields are empty in the new log if they differ between the logs. If several logs
    contain a message with the same time and bytes, it is written once.

    Args:
        data: Two or more logs: files, folders or globs.
        out: Path of the new log.
        shift: Whether to delay a log whose episodes overlap in time with episodes of earlier logs.
            The log then begins after the earlier logs end. The timestamps inside its messages are
            delayed, too.
        overwrite: Whether an existing file is replaced.

    Raises:
        UsageError: There are fewer than two logs.
        OutputExistsError: `out` exists.
        SpaceError: The spaces differ.
        LogError: A log cannot be read. Or the environment, names or step duration differ. Or
            episodes of two logs overlap in time, and `shift` is not set.
    """
    return merge_logs(data, check_log_name(out), shift=shift, overwrite=overwrite)


def split(
    data: str | Path,
    out: str | Path,
    *,
    episodes: int | None = None,
    ratio: Sequence[float] | None = None,
    seed: int | None = None,
    overwrite: bool = False,
) -> list[Edited]:
    """Divide the episodes of a log among several new logs.

    A message is copied with the episode during which or after which it was logged. Messages that
    remain valid for later episodes, such as the static scene, are copied to each new log that needs
    them.

    Args:
        data: Path of the log.
        out: New folder of the logs, which are named `NAME-00000.mcap`, `NAME-00001.mcap` and so on.
        episodes: Number of episodes of each new log; the last one may have fewer.
        ratio: Relative number of episodes of each new log, such as (8, 1, 1).
        seed: Seed of a random assignment of episodes to logs; None to assign them in their order.
        overwrite: Whether an existing folder is replaced.

    Raises:
        UsageError: Not exactly one of `episodes` and `ratio` is given, or a log would be empty.
        OutputExistsError: `out` exists.
        LogError: The log cannot be read, is not finished, or has no episodes.
    """
    return split_log(data, out, episodes=episodes, ratio=ratio, seed=seed, overwrite=overwrite)


def filter(
    expression: str, data: str | Path, out: str | Path, *, overwrite: bool = False
) -> Edited:
    """Copy the episodes for which an expression is true to a new log.

    The expression is a condition such as `"length > 100 and reason != 'crash'"`. It can use
    numbers, strings, operators, and these columns of the table of episodes: `episode` (its index,
    from 0), `length`, `total_reward`, `terminated`, `truncated`, `reason`, `policy`, `epsilon`,
    `seed` (NaN if there was none), `options`, `start_s` (time since the start of the first
    episode) and `duration_s`. Of labels, it can use `success` (NaN without a label), `note` (empty
    without a label), and whether the episode has an interval of a name, as `labels.intervention`.

    Args:
        expression: Condition on an episode.
        data: Path of the log.
        out: Path of the new log.
        overwrite: Whether an existing file is replaced.

    Raises:
        UsageError: The expression is not a condition, or names an unknown column.
        OutputExistsError: `out` exists.
        NoEpisodesError: The expression is true for no episode.
        LogError: The log cannot be read, or is not finished.
    """
    return filter_log(expression, data, check_log_name(out), overwrite=overwrite)


def select(data: Source, *, only: str | None = None, mask: str | Sequence[str] = ()) -> Dataset:
    """Return the episodes for which an expression is true, without the steps of some intervals.

    `mcaprl info`, `evaluate --data` and `train-offline` select their data in this way.

    Args:
        data: Dataset, or path of the logs; see `open`.
        only: Condition on an episode, such as `"success == 1"`; see `filter`. None for all.
        mask: Names of labeled intervals, whose steps are left out; see `label` and
            `Dataset.without`.

    Raises:
        UsageError: The expression is not a condition; or the data are still growing, or have not
            exactly the episodes of their logs, so that their labels are not known.
        UnknownNameError: There is no such column, or no interval of such a name.
        NoEpisodesError: The expression is true for no episode.
        LogError: The labels cannot be read, or belong to different data.
    """
    return selected(opened(data), only, as_names(mask))


def slice(
    data: str | Path,
    out: str | Path,
    *,
    steps: Bounds | None = None,
    time: Bounds | None = None,
    overwrite: bool = False,
) -> Edited:
    """Copy the part of a log between two steps or times to a new log.

    An episode that is only partly in the range becomes a shorter episode. If its beginning is
    missing, its steps are numbered from 0, and it has no seed. If its end is missing, it is
    truncated with the reason `interrupted`.

    Args:
        data: Path of the log; with `time`, any finished MCAP file.
        out: Path of the new log.
        steps: Half-open range (start, stop) of transitions, counted from 0 over all episodes. A
            bound of None is the start or end of the log.
        time: Half-open range (start, stop) in seconds since the first message of the log. A bound
            of None is the start or end of the log.
        overwrite: Whether an existing file is replaced.

    Raises:
        UsageError: Not exactly one of `steps` and `time` is given, or the range is empty.
        OutputExistsError: `out` exists.
        NoEpisodesError: The range has no complete transition.
        LogError: The log cannot be read, or is not finished.
    """
    return slice_log(data, check_log_name(out), steps=steps, time=time, overwrite=overwrite)


def relabel(
    data: Paths | Dataset, out: str | Path, *, reward: str, overwrite: bool = False
) -> Dataset:
    """Write the transitions of a log with another reward.

    The reward is an expression of numbers, operators and functions, as in a mapping file, such as
    `"next(speed) - 0.1 * abs(action)"`. Per transition, it can use: `action` (an element of a Box
    action as `action[0]`), `reward` (the logged one), `terminated`, `truncated`, the names of the
    observation's elements, `observation` or the parts of a Dict observation (`observation[2]`), and
    numeric infos. `next(...)` is a value with the observation that the transition leads to.

    Args:
        data: Dataset, or path of the logs.
        out: Path of the new log. It has the transitions; the scene and other topics are not copied.
        reward: Expression.
        overwrite: Whether an existing file is replaced.

    Returns:
        The dataset with the new rewards.

    Raises:
        UsageError: The expression is not valid, or a reward is not finite.
        UnknownNameError: The expression has an unknown name.
        OutputExistsError: `out` exists.
        LogError: A log cannot be read.
    """
    path = check_log_name(out)
    dataset = relabeled(data if isinstance(data, Dataset) else open_data(data), reward)
    dataset.save(path, overwrite=overwrite)
    return dataset


def label(
    data: str | Path,
    *,
    episode: int | None = None,
    success: bool | None = None,
    note: str | None = None,
    interval: str | None = None,
    steps: Bounds | None = None,
    time: Bounds | None = None,
    remove: bool = False,
    file: str | Path | None = None,
    mapping: MappingFile | None = None,
    trust_code: bool = False,
    definitions: Definitions = (),
) -> Labels:
    """Label episodes and intervals of a log; without arguments, return its labels.

    The labels are in `LOG.labels.json` beside the log, which is not changed. The file names the
    log's data by a hash: labels are never read for other data.

    A recording of another robot is labeled by the episodes that a mapping finds in it, without the
    mapping's conditions that use labels. A mapping that finds other episodes is refused.

    Args:
        data: Path of the log; or, with `mapping`, of one recording.
        episode: Index of the episode, from 0.
        success: Whether the episode succeeded.
        note: Note on the episode.
        interval: Name of an interval to add, such as `intervention`.
        steps: Half-open range (start, stop) of the interval's steps in the episode, from 0.
        time: The range in seconds since the start of the episode, instead of `steps`. Without
            both, the interval is the whole episode.
        remove: Whether to remove labels: those of `episode`, the intervals named `interval`, or
            these in `episode`; all labels without both.
        file: CSV file with a header or JSON list of labels to add, with the keys `episode`,
            `success`, `note`, `interval`, `start` and `stop` (steps); instead of other arguments.
        mapping: Mapping of a bag; see `open`.
        trust_code: Whether the mapping may name a Python function, which is imported.
        definitions: Files and folders with definitions of ROS types that the bag lacks.

    Returns:
        All labels of the log.

    Raises:
        UsageError: There is no such episode, the interval is not within it, or arguments exclude
            each other. Nothing is saved.
        LogError: The log or its labels cannot be read, or belong to different data or episodes.
    """
    if is_url(data):
        raise UsageError(f"{data} cannot be labeled: copy the log to this machine")
    given: dict[str, Any] = {"episode": episode, "success": success, "note": note}
    given |= {"interval": interval, "steps": steps, "time": time, "remove": remove or None}
    change = {name: value for name, value in given.items() if value is not None}
    if file is not None and change:
        raise UsageError(f"`file=` and `{next(iter(change))}=` exclude each other")
    changes = list(changes_in(Path(file))) if file is not None else [change] if change else []
    if mapping is None:
        return change_labels(Path(data), changes)
    return change_labels(labeled_recording(data, mapping, trust_code, definitions), changes)


@dataclass(frozen=True)
class Annotation:
    """Topics that were added to a copy of a log.

    Attributes:
        out: Path of the copy.
        steps: Number of steps of the log.
        topics: Topic of each policy's values, by the policy's path.
        scene: Number of episodes and number of steps to which the scene or the video was added;
            None without both.
        labels: Whether the log has labels, which were added as `/rl/labels` and beside the copy.
    """

    out: Path
    steps: int
    topics: dict[str, str]
    scene: Verification | None
    labels: bool = False


def annotate(
    data: str | Path | Dataset,
    out: str | Path,
    *,
    policy: Names = (),
    gamma: float | None = None,
    scene: bool = False,
    camera: bool | str = False,
    sim: str | None = None,
    trust_env: bool = False,
    trust_code: bool = False,
    sim_options: Mapping[str, Any] | None = None,
    keep_topics: bool | str | Sequence[str] | None = None,
    overwrite: bool = False,
    progress: ProgressBar = no_progress,
) -> Annotation:
    """Copy a log with all of its topics; add values of policies, its labels, or the sim's scene.

    Args:
        data: Path of the log; or a dataset that `open` read from a bag by a mapping, which is first
            saved as a log.
        out: Path of the copy.
        policy: Path of a trained run, or any other policy of `mcaprl.action_errors`, or several. Of
            an ONNX file, a function and predictions, the first action of each step is added; their
            values are unknown.
        gamma: Discount of the TD errors; None for the discount of the run.
        scene: Whether to repeat the logged actions in the sim and add its scene.
        camera: Whether to add metric depth images to the scene; or `h264` to repeat the logged
            actions and add a video of what the environment renders, with or without `scene`.
        sim: Short name or Gymnasium id to use instead of the logged one.
        trust_env: Whether to import the module that the logged id names, and to pass the logged
            arguments to environments other than the sims of `SIMS`.
        trust_code: Whether a policy `module:function` is imported.
        sim_options: With `scene`, arguments of the environment that replace the logged ones.
        keep_topics: With the dataset of a bag, its topics that are kept; see `convert`.
        overwrite: Whether an existing file is replaced.
        progress: Function that opens a progress bar.

    Raises:
        UsageError: Nothing is requested, the log already has a requested topic, `gamma` is out of
            range, or `module:function` is not trusted or cannot be imported.
        UnknownNameError: There is no such policy.
        PolicyError: A policy was trained on other spaces than those of the log, fails, or returns
            other shapes.
        LogError: The log cannot be read, or the sim does not reproduce it.
        OutputExistsError: `out` exists.
    """
    check_fraction(gamma=gamma)
    names, added = as_names(policy), None
    replays = scene or isinstance(camera, str)
    check_log_name(out)
    if isinstance(data, Dataset):
        if replays:
            raise UsageError("the scene of a bag cannot be added: there is no sim to step")
        check_target(Path(out), overwrite=overwrite)
        with temporary_folder() as folder:
            log = folder / "converted.mcap"
            data.save(log, keep_topics=keep_topics)
            if data.origin.labels:
                carry_labels(labels_of(data), np.arange(len(data.episodes)), log)
            options: Any = {"gamma": gamma, "overwrite": overwrite, "progress": progress}
            return annotate(log, out, policy=policy, trust_code=trust_code, **options)
    if keep_topics:
        raise UsageError("keep_topics is for bags: annotate keeps all topics of a log")
    path = as_path(data, whole=True)
    dataset, labels = open_data(path), None if is_url(data) else labels_to_carry(Path(data))
    if not names and not replays and labels is None:
        raise UsageError(
            "annotate needs `policy=POLICY`, `scene=True`, `camera='h264'`, or a log with labels"
        )
    found = values_topics(list(policy_names(names).values()))
    topics = dict(zip(dict.fromkeys(names), found.values(), strict=True))
    with annotated_copy(path, Path(out), overwrite=overwrite) as copy:
        for name, topic in topics.items():
            if is_foreign(name):
                copy.add_values(topic, _actions(dataset, name, progress, trust_code=trust_code))
            else:
                copy.add_values(topic, _values(dataset, name, gamma, progress))
        if labels is not None:
            copy.add_labels(labels.texts(dataset))
        if replays:
            given: Any = {"trust_env": trust_env, "sim_options": sim_options}
            if isinstance(camera, str):
                given["render_mode"] = "rgb_array"
            with closing(sim_of(dataset, path, sim, **given)) as env:
                added = copy.add_scene(dataset, env, scene=scene, camera=camera)
    carry_labels(labels, np.arange(len(dataset.episodes)), Path(out))
    return Annotation(Path(out), len(dataset), topics, added, labels is not None)


def _values(
    dataset: Dataset, name: str, gamma: float | None, progress: ProgressBar
) -> list[tuple[Any, Any]]:
    """Compute the values that a run's first policy assigns to the steps of each episode."""
    from mcaprl.offline.estimate.values import gamma_of_run, value_columns

    policy: Any = trained_policies(name, dataset)[0]
    discount = gamma_of_run(Path(name)) if gamma is None else gamma
    found = []
    with progress(f"evaluating {name}", len(dataset.episodes)) as advance:
        for episode in dataset.episodes:
            columns = value_columns(policy, episode, dataset.action_space, discount)
            found.append((episode.log_time_ns[:-1], columns))
            advance(1)
    return found


def _actions(
    dataset: Dataset, name: str, progress: ProgressBar, *, trust_code: bool
) -> list[tuple[Any, Any]]:
    """Return the first action that any policy has at the steps of each episode."""
    from mcaprl.offline.estimate.action_error import predicted
    from mcaprl.offline.estimate.values import action_columns

    (actor,) = actors_of(name, dataset, trust_code=trust_code)
    numbers = range(len(dataset.episodes)) if actor.compared is None else actor.compared
    found = []
    with progress(f"evaluating {name}", len(numbers)) as advance:
        for number in numbers:
            episode = dataset.episodes[number]
            actions = predicted(dataset, actor, [number])[0][0][:, 0]
            known = np.isfinite(actions.reshape(len(actions), -1)).all(1)
            advance(1)
            if known.any():
                taken, times_ns = episode.actions[known], episode.log_time_ns[:-1][known]
                columns = action_columns(actions[known], taken, dataset.action_space)
                found.append((times_ns, columns))
    return found
