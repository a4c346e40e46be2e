"""Evaluation on the workers of a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from mcaprl.api.cluster import ClusterOptions
from mcaprl.api.policies import SCRIPTED, policies_of
from mcaprl.errors import ClusterError
from mcaprl.progress import Advance
from mcaprl.sims import make_sims
from mcaprl.sims.evaluation.evaluate import greedy_episodes
from mcaprl.sims.evaluation.rollout import EpisodeResult, make_limited

# Number of episodes that a worker runs as one task. The number of workers has no effect on the
# parts, and thus on the results.
_PART_EPISODES = 10


class _Part(NamedTuple):
    """Episodes of the policy of one training seed."""

    name: str
    policy: str
    candidate: int
    first: int
    episodes: int


def results_on_ray(
    found: Mapping[str, Sequence[object]],
    episodes: int,
    options: ClusterOptions,
    advance: Advance,
    **setting: Any,
) -> dict[str, list[list[EpisodeResult]]]:
    """Run the episodes of each policy and training seed on Ray workers, and return them.

    Args:
        found: Policies of the training seeds, by name or path.
        episodes: Number of episodes of each policy.
        options: Cluster and workers.
        advance: Function called with the number of finished episodes.
        **setting: Named arguments of `_run_part`.

    Raises:
        ClusterError: The cluster cannot be used, or workers died repeatedly.
        MissingExtraError: Ray is not installed.
    """
    from mcaprl.ray.tasks import WorkerDiedError, run_tasks

    # Workers have other working directories, so all paths must be absolute.
    paths = {name: Path(name).absolute() for name in found if name not in SCRIPTED}
    parts = [
        _Part(name, str(paths.get(name, name)), index, first, min(_PART_EPISODES, episodes - first))
        for name, candidates in found.items()
        for index in range(len(candidates))
        for first in range(0, episodes, _PART_EPISODES)
    ]
    with options.connected():
        try:
            done = run_tasks(
                partial(_run_part, **setting),
                parts,
                workers=options.workers,
                paths=list(paths.values()),
                advance=advance,
            )
        except WorkerDiedError as error:
            raise ClusterError(
                f"workers died repeatedly while they evaluated {parts[error.index].name}:"
                f" {error.cause}"
            ) from error
    results = {name: [list[EpisodeResult]() for _ in each] for name, each in found.items()}
    for part, some in zip(parts, done, strict=True):
        results[part.name][part.candidate] += some
    return results


def _run_part(
    part: _Part,
    send: Callable[[int], None],
    *,
    sim: str,
    sim_options: Mapping[str, Any],
    seed: int,
    is_batched: bool,
    max_steps: int | None,
    mask_from: str,
) -> list[EpisodeResult]:
    done = 0

    def on_episode(_: EpisodeResult) -> None:
        nonlocal done
        done += 1
        send(done)

    with closing(make_limited(sim, max_steps, **sim_options)) as env:
        is_batched = is_batched and part.policy not in SCRIPTED
        return greedy_episodes(
            env,
            policies_of(part.policy, env)[part.candidate],
            episodes=part.episodes,
            seed=seed,
            first_episode=part.first,
            envs=make_sims(sim, part.episodes, **sim_options) if is_batched else None,
            mask_from=mask_from,
            on_episode=on_episode,
        )
