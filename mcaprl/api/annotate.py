"""Annotation: values of policies, or the scene of the sim, in a copy of a log."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcaprl.api.environments import sim_of
from mcaprl.api.policies import Names, as_names, policy_names, trained_policies
from mcaprl.api.ranges import check_fraction
from mcaprl.errors import UsageError
from mcaprl.progress import ProgressBar, no_progress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.open import open_logs
from mcaprl.recorder.viewer.annotate import AnnotatedCopy, values_topics
from mcaprl.recorder.viewer.verify import Verification


@dataclass(frozen=True)
class Annotation:
    """Topics that were added to a copy of a log.

    Attributes:
        out: Path of the copy.
        steps: Number of steps of the log.
        topics: Topic of each policy.
        scene: Episodes and steps that the scene was added to; None without a scene.
    """

    out: Path
    steps: int
    topics: dict[str, str]
    scene: Verification | None


def annotate(
    file: str | Path,
    out: str | Path,
    *,
    policy: Names = (),
    gamma: float | None = None,
    scene: bool = False,
    camera: bool = False,
    sim: str | None = None,
    overwrite: bool = False,
    progress: ProgressBar = no_progress,
) -> Annotation:
    """Copy a log, and add values of policies or the scene of the sim to each step.

    Args:
        file: Path of the log.
        out: Path of the copy.
        policy: Path of a trained run, or several of them.
        gamma: Discount of the TD errors; None for the run's.
        scene: Whether the sim is stepped again to add its scene.
        camera: Whether the scene has metric depth images, too.
        sim: Short name or Gymnasium id that replaces the log's.
        overwrite: Whether an existing file is replaced.
        progress: Opens the progress bar.

    Raises:
        UsageError: There is nothing to add, the log has it already, or `gamma` is out of its range.
        UnknownNameError: There is no such policy.
        PolicyError: A policy was trained on other spaces than the log's.
        LogError: The log cannot be read, or the sim does not repeat it.
        OutputExistsError: `out` exists.
    """
    check_fraction(gamma=gamma)
    path, names, added = Path(file), as_names(policy), None
    if not names and not scene:
        raise UsageError("annotate needs --policy POLICY, --scene, or both")
    dataset = open_logs(path)
    found = values_topics(list(policy_names(names).values()))
    topics = dict(zip(dict.fromkeys(names), found.values(), strict=True))
    with AnnotatedCopy(path, Path(out), overwrite=overwrite) as copy:
        for name, topic in topics.items():
            copy.add_values(topic, _values(dataset, name, gamma, progress))
        if scene:
            with closing(sim_of(dataset, path, sim)) as env:
                added = copy.add_scene(dataset, env, camera=camera)
    return Annotation(Path(out), len(dataset), topics, added)


def _values(
    dataset: Dataset, name: str, gamma: float | None, progress: ProgressBar
) -> list[tuple[Any, Any]]:
    """Return each episode with the values of the first policy of a run."""
    from mcaprl.offline.estimate.values import gamma_of_run, value_columns

    policy: Any = trained_policies(name, dataset)[0]
    discount = gamma_of_run(Path(name)) if gamma is None else gamma
    found = []
    with progress(f"evaluating {name}", len(dataset.episodes)) as advance:
        for episode in dataset.episodes:
            found.append((episode, value_columns(policy, episode, dataset.action_space, discount)))
            advance(1)
    return found
