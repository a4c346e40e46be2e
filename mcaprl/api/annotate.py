"""Annotation: values of policies, or the scene of the sim, in a copy of a log."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcaprl.api.environments import sim_of
from mcaprl.api.policies import Names, as_names, policy_names, trained_policies
from mcaprl.api.ranges import check_fraction
from mcaprl.errors import UsageError
from mcaprl.files import check_log_name, check_target, temporary_folder
from mcaprl.progress import ProgressBar, no_progress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.source import open_data
from mcaprl.recorder.viewer.annotate import annotated_copy, values_topics
from mcaprl.recorder.viewer.verify import Verification
from mcaprl.storage.remote import as_path


@dataclass(frozen=True)
class Annotation:
    """Topics that were added to a copy of a log.

    Attributes:
        out: Path of the copy.
        steps: Number of steps of the log.
        topics: Topic of each policy's values, by the policy's path.
        scene: Number of episodes and number of steps to which the scene was added; None without a
            scene.
    """

    out: Path
    steps: int
    topics: dict[str, str]
    scene: Verification | None


def annotate(
    data: str | Path | Dataset,
    out: str | Path,
    *,
    policy: Names = (),
    gamma: float | None = None,
    scene: bool = False,
    camera: bool = False,
    sim: str | None = None,
    trust_env: bool = False,
    sim_options: Mapping[str, Any] | None = None,
    overwrite: bool = False,
    progress: ProgressBar = no_progress,
) -> Annotation:
    """Copy a log, and add values of policies or the scene of the sim to each step.

    Args:
        data: Path of the log; or a dataset that `open` read from a bag by a mapping, which is first
            saved as a log.
        out: Path of the copy.
        policy: Path of a trained run, or several paths.
        gamma: Discount of the TD errors; None for the discount of the run.
        scene: Whether to repeat the logged actions in the sim and add its scene.
        camera: Whether to add metric depth images to the scene.
        sim: Short name or Gymnasium id to use instead of the logged one.
        trust_env: Whether to import the module that the logged id names, and to pass the logged
            arguments to environments other than the sims of `SIMS`.
        sim_options: With `scene`, arguments of the environment that replace the logged ones.
        overwrite: Whether an existing file is replaced.
        progress: Function that opens a progress bar.

    Raises:
        UsageError: Nothing is requested, the log already has a requested topic, or `gamma` is out
            of range.
        UnknownNameError: There is no such policy.
        PolicyError: A policy was trained on other spaces than those of the log.
        LogError: The log cannot be read, or the sim does not reproduce it.
        OutputExistsError: `out` exists.
    """
    check_fraction(gamma=gamma)
    names, added = as_names(policy), None
    check_log_name(out)
    if not names and not scene:
        raise UsageError("annotate needs `policy=POLICY`, `scene=True`, or both")
    if isinstance(data, Dataset):
        if scene:
            raise UsageError("the scene of a bag cannot be added: there is no sim to step")
        check_target(Path(out), overwrite=overwrite)
        with temporary_folder() as folder:
            log = folder / "converted.mcap"
            data.save(log)
            options: Any = {"gamma": gamma, "overwrite": overwrite, "progress": progress}
            return annotate(log, out, policy=policy, **options)
    path = as_path(data, whole=True)
    dataset = open_data(path)
    found = values_topics(list(policy_names(names).values()))
    topics = dict(zip(dict.fromkeys(names), found.values(), strict=True))
    with annotated_copy(path, Path(out), overwrite=overwrite) as copy:
        for name, topic in topics.items():
            copy.add_values(topic, _values(dataset, name, gamma, progress))
        if scene:
            trust: Any = {"trust_env": trust_env, "sim_options": sim_options}
            with closing(sim_of(dataset, path, sim, **trust)) as env:
                added = copy.add_scene(dataset, env, camera=camera)
    return Annotation(Path(out), len(dataset), topics, added)


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
            found.append((episode, value_columns(policy, episode, dataset.action_space, discount)))
            advance(1)
    return found
