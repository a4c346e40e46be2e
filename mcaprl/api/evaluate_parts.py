"""Evaluation on the workers of a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mcaprl.api.cluster import ClusterOptions
from mcaprl.api.policies import SCRIPTED, policies_of
from mcaprl.errors import ClusterError
from mcaprl.progress import Advance
from mcaprl.sims import make_sims
from mcaprl.sims.evaluation.evaluate import greedy_episodes
from mcaprl.sims.evaluation.limits import make_limited
from mcaprl.sims.evaluation.rollout import EpisodeResult

# Number of episodes that a worker runs as one task.
_PART_EPISODES = 10


@dataclass(frozen=True)
class Part:
    """Episodes of one policy that a Ray worker runs.

    Attributes:
        sim: Short name or Gymnasium id.
        options: Arguments of the environment.
        seed: Seed of the evaluation.
        is_batched: Whether the sim steps several environments at once.
        max_steps: Limit on the steps of an episode; see `make_limited`.
        policy: Name or path of the policy.
        index: Index of the policy's training seed.
        first: Number of the first episode.
        episodes: Number of episodes.
        mask_from: Source of the mask of random actions.
    """

    sim: str
    options: Mapping[str, Any]
    seed: int
    is_batched: bool
    max_steps: int | None = None
    policy: str = ""
    index: int = 0
    first: int = 0
    episodes: int = 0
    mask_from: str = ""


def results_on_ray(
    request: Part,
    found: Mapping[str, Sequence[object]],
    episodes: int,
    options: ClusterOptions,
    advance: Advance,
) -> dict[str, list[list[EpisodeResult]]]:
    """Run the episodes of each policy and training seed on Ray workers, and return them.

    The number of workers has no effect on the results, because the episodes are always divided into
    the same parts.

    Args:
        request: Sim and seed.
        found: Policies of the training seeds, by name or path.
        episodes: Number of episodes of each policy.
        options: Cluster and workers.
        advance: Function called with the number of finished episodes.

    Raises:
        ClusterError: The cluster cannot be used, or workers died repeatedly.
        MissingExtraError: Ray is not installed.
    """
    from mcaprl.ray.tasks import WorkerDiedError, advancing, run_tasks

    # Workers have other working directories, so all paths must be absolute.
    paths = {name: Path(name).absolute() for name in found if name not in SCRIPTED}
    parts, keys = [], []
    for name, candidates in found.items():
        for index in range(len(candidates)):
            for first in range(0, episodes, _PART_EPISODES):
                number = min(_PART_EPISODES, episodes - first)
                policy = str(paths.get(name, name))
                parts.append(
                    replace(request, policy=policy, index=index, first=first, episodes=number)
                )
                keys.append((name, index))
    with options.connected():
        try:
            done = run_tasks(
                _run_part,
                parts,
                workers=options.workers,
                paths=list(paths.values()),
                on_message=advancing(advance),
            )
        except WorkerDiedError as error:
            name, _ = keys[error.index]
            raise ClusterError(
                f"workers died repeatedly while they evaluated {name}: {error.cause}"
            ) from error
    results = {name: [list[EpisodeResult]() for _ in each] for name, each in found.items()}
    for (name, index), some in zip(keys, done, strict=True):
        results[name][index] += some
    return results


def _run_part(part: Part, send: Callable[[int], None]) -> list[EpisodeResult]:
    done = 0

    def on_episode(_: EpisodeResult) -> None:
        nonlocal done
        done += 1
        send(done)

    with closing(make_limited(part.sim, part.max_steps, **part.options)) as env:
        is_batched = part.is_batched and part.policy not in SCRIPTED
        return greedy_episodes(
            env,
            policies_of(part.policy, env)[part.index],
            episodes=part.episodes,
            seed=part.seed,
            first_episode=part.first,
            envs=make_sims(part.sim, part.episodes, **part.options) if is_batched else None,
            mask_from=part.mask_from,
            on_episode=on_episode,
        )
