"""Recording of one file in this process."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym

from mcaprl.api.policies import policies_of, policy_names
from mcaprl.base_policy import BasePolicy
from mcaprl.files import work_folder
from mcaprl.recorder.format.behavior import behavior_field
from mcaprl.recorder.record.wrapper import RecordMcap
from mcaprl.sims.evaluation.rollout import (
    EpisodeResult,
    EpsilonGreedy,
    NoisyPolicy,
    make_limited,
    make_or_borrow,
    noisy_name,
    rollout,
)


@dataclass(frozen=True)
class FileRequest:
    """One file to record; its fields are the arguments of `record`.

    Attributes:
        first_episode: Number of the first episode; an episode's seed depends on its number.
    """

    sim: str | gym.Env[Any, Any]
    out: Path
    policy: str | BasePolicy
    epsilon: float
    noise: float
    noise_per_episode: bool
    episodes: int | None
    steps: int | None
    seed: int
    sim_options: Mapping[str, Any]
    scene: bool
    camera: bool
    infos: bool | Sequence[str]
    keys: Sequence[str] | None
    compression: str
    overwrite: bool
    append: bool
    rotate_mb: float | None
    max_steps: int | None
    first_episode: int = 0

    @property
    def policy_name(self) -> str:
        """Name of the policy in the log."""
        given = self.policy
        name = given.name if isinstance(given, BasePolicy) else policy_names([given])[given]
        return noisy_name(name, self.noise, per_episode=self.noise_per_episode)


def record_file(
    request: FileRequest, on_episode: Callable[[EpisodeResult], None] | None = None
) -> list[EpisodeResult]:
    """Record one file in this process."""
    with closing(_env(request)) as env:
        behavior = _behavior(request, env)
        recorder = _recorder(request, env, behavior)

        name = behavior_field(env.action_space).name

        def set_behavior(value: float) -> None:
            setattr(recorder, name, value)

        with closing(recorder):
            return rollout(
                recorder,
                behavior,
                seed=request.seed,
                episodes=request.episodes,
                steps=request.steps,
                # Appended episodes continue the numbering, which determines the seeds.
                first_episode=request.first_episode + recorder.episodes,
                on_action=set_behavior,
                on_episode=on_episode,
            )


def try_request(request: FileRequest) -> None:
    """Create the file of a request and remove it, to find errors before the first episode.

    Raises:
        McaprlError: The sim, the policy or another argument is not valid.
    """
    with (
        work_folder(request.out) as trial,
        closing(_env(request)) as env,
    ):
        behavior = _behavior(request, env)
        _recorder(replace(request, out=trial / "trial.mcap"), env, behavior).close()


def _env(request: FileRequest) -> gym.Env[Any, Any]:
    # A number of steps ends the recording, so it needs no default limit.
    if request.steps is not None and request.max_steps is None:
        return make_or_borrow(request.sim, **request.sim_options)
    return make_limited(request.sim, request.max_steps, **request.sim_options)


def _behavior(request: FileRequest, env: gym.Env[Any, Any]) -> EpsilonGreedy:
    policy, space = policies_of(request.policy, env)[0], env.action_space
    if request.noise:
        policy = NoisyPolicy(policy, request.noise, space, per_episode=request.noise_per_episode)
    return EpsilonGreedy(policy, request.epsilon, space)


def _recorder(request: FileRequest, env: gym.Env[Any, Any], behavior: EpsilonGreedy) -> RecordMcap:
    megabytes = request.rotate_mb
    return RecordMcap(
        env,
        request.out,
        policy=request.policy_name,
        epsilon=behavior.epsilon,
        seed=request.seed,
        compression=request.compression,
        overwrite=request.overwrite,
        append=request.append,
        max_file_bytes=None if megabytes is None else math.ceil(megabytes * 1e6),
        scene=request.scene,
        camera=request.camera,
        infos=request.infos,
        keys=request.keys,
    )
