"""Evaluation of policies in a sim, and comparison of their returns."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym

from mcaprl.api.environments import all_options, check_names, name_of, trained_options
from mcaprl.api.policies import SCRIPTED, Names, by_name, policies_of, policy_names
from mcaprl.api.ranges import ClusterOptions, check_least
from mcaprl.base_policy import Actor, BasePolicy
from mcaprl.errors import ClusterError, ReportError, UsageError, import_extra
from mcaprl.files import check_log_name, check_target, check_writable, write_json
from mcaprl.page import Figure
from mcaprl.progress import Advance, ProgressBar, no_progress
from mcaprl.recorder.format.metadata import same_env
from mcaprl.recorder.record.wrapper import RecordMcap
from mcaprl.recorder.source import Data, named, opened
from mcaprl.sims import make_sims
from mcaprl.sims.evaluation.evaluate import (
    Improvement,
    PolicyScore,
    Scale,
    greedy_episodes,
    has_pilot,
    improvements,
    mean_interval,
    normalize,
    score_of,
)
from mcaprl.sims.evaluation.evaluate import evaluate as evaluate_policy
from mcaprl.sims.evaluation.rollout import EpisodeResult, StepLimit, make_limited, warn_of_cuts

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
    """Run the episodes of each policy and training seed on Ray workers, and return them."""
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


RESULT_NAME = "evaluation.json"


@dataclass(frozen=True)
class LoggedReturns:
    """Returns of the episodes in logs.

    Attributes:
        data: File, folder or glob.
        episodes: Number of episodes.
        mean_return: Mean of the returns.
        interval: 95 % interval of the mean.
        normalized_score: Mean return on the scale where random is 0 and the pilot is 1; None
            without a pilot.
    """

    data: str
    episodes: int
    mean_return: float
    interval: tuple[float, float]
    normalized_score: float | None = None


@dataclass(frozen=True)
class Evaluation:
    """Returns of policies in a sim.

    Attributes:
        sim: Short name or Gymnasium id.
        seed: Seed of the episodes.
        behavior: Returns of the logs that the policies are compared with; None if there are none.
        policies: Score of each policy, and of random and the pilot.
        improvements: Comparison of each pair of policies.
    """

    sim: str
    seed: int
    behavior: LoggedReturns | None
    policies: tuple[PolicyScore, ...]
    improvements: tuple[Improvement, ...]

    def to_json(self) -> dict[str, Any]:
        """Return what `evaluate --json` prints."""
        return {
            "sim": self.sim,
            "seed": self.seed,
            "behavior": self.behavior and asdict(self.behavior),
            "policies": [score.to_json() for score in self.policies],
            "improvements": [improvement.to_json() for improvement in self.improvements],
        }


def evaluate(
    policies: Names | Actor | Sequence[Names | Actor],
    sim: str | gym.Env[Any, Any],
    *,
    episodes: int = 30,
    max_steps: int | None = None,
    seed: int = 1_000_000,
    observation: str | None = None,
    rules: str | None = None,
    actions: str | int | None = None,
    sim_options: Mapping[str, Any] | None = None,
    trust_env: bool = False,
    behavior: Data | None = None,
    record: str | Path | None = None,
    keys: Sequence[str] | None = None,
    report: str | Path | None = None,
    overwrite: bool = False,
    mask_from: str | None = None,
    ray: bool = False,
    workers: int | None = None,
    address: str | None = None,
    progress: ProgressBar = no_progress,
) -> Evaluation:
    """Evaluate policies greedily on the same episodes of a sim.

    Random actions and the sim's pilot are always evaluated, too.

    Args:
        policies: `pilot`, `random`, the path of a trained policy, a policy or another object with a
            method `act(observations)` for batches of observations, or a list of these. Each seed of
            a run is evaluated.
        sim: Short name of a sim, a Gymnasium id, or an environment, which stays open.
        episodes: Number of episodes for each policy and training seed.
        max_steps: Steps after which an episode is truncated, with the reason `step_limit`. None
            selects 27,000 if the environment has no time limit.
        seed: Seed of the episodes.
        observation: Observation that the sim returns, such as `depth`.
        rules: Rules of the sim, such as `classic`.
        actions: Actions of the sim, such as `continuous`.
        sim_options: Other arguments of the environment. Without any argument, the environment has
            the arguments with which `policies` were trained in it.
        trust_env: Whether the arguments of the training may be passed to environments other than
            the sims of `SIMS`.
        behavior: Dataset or logs of the sim that the policies are compared with.
        record: Output log of the episodes of `policies`.
        keys: Keys of the parts of a Dict or Tuple observation that `record` contains; default: all.
        report: Output folder of the HTML report, images and JSON.
        overwrite: Whether an existing log is replaced.
        mask_from: Source of the flags of the allowed actions, for random actions: `info:NAME`, or
            a key of the observation. None selects that of the trained policies.
        ray: Whether the episodes run on Ray workers. The results are the same. All workers must be
            able to read the policies.
        workers: Number of Ray workers; default: number of CPUs of the cluster.
        address: Address of a Ray cluster, `HOST:PORT` or `auto`; default: RAY_ADDRESS, else a
            local cluster for this call.
        progress: Function that opens a progress bar.

    Raises:
        UsageError: `behavior` was recorded in another sim or would be overwritten, a number is
            out of range, or options exclude each other.
        UnknownNameError: There is no such sim or policy.
        PolicyError: A policy has other spaces than the sim.
        OutputExistsError: `record` exists.
        MissingExtraError: The packages of the sim, the policies, the report or Ray are not
            installed.
        ReportError: The report cannot be written.
        ClusterError: The Ray cluster cannot be used, or its workers died repeatedly.
    """
    check_least(1, episodes=episodes, max_steps=max_steps)
    check_least(0, seed=seed)
    on_cluster = ClusterOptions(ray, workers, address)
    on_cluster.check()
    if ray and record is not None:
        raise UsageError("`record=` needs one process: omit `ray=True`")
    if keys is not None and record is None:
        raise UsageError("`keys=` selects what `record=` writes: omit it, or pass `record=`")
    given, options = by_name(policies), all_options(observation, rules, actions, sim_options)
    paths = [policy for policy in given.values() if isinstance(policy, str)]
    options = trained_options(paths, sim, options, trust_env=trust_env)
    if ray:
        check_names(sim, *given.values())
    sim_name = name_of(sim)
    log, folder = (None if path is None else Path(path) for path in (record, report))
    if log is not None:
        check_log_name(log)
    env = make_limited(sim, max_steps, **options)
    with closing(env):
        # Arguments are checked first, because the episodes may take minutes.
        logged = None if behavior is None else _behavior(behavior, env, log)
        if folder is not None:
            import_extra("matplotlib", "report")
            import_extra("jinja2", "report")
            check_writable(folder / RESULT_NAME, ReportError)
        if log is not None:
            check_target(log, overwrite=overwrite)
        world = list(getattr(env.unwrapped, "static_scene", list)())
        # Batched sims have no other limit than their own, and no recorder of single episodes.
        is_plain = isinstance(sim, str) and log is None and not isinstance(env, StepLimit)
        is_batched = is_plain and env.spec is not None and bool(env.spec.vector_entry_point)
        found = _policies(given, env)
        shown, scores = {name: name for name in found} | policy_names(paths), {}
        sources = [one.mask_from for each in found.values() for one in each]
        source = next(filter(None, sources), "") if mask_from is None else mask_from
        with ExitStack() as stack:
            total = sum(map(len, found.values())) * episodes
            advance = stack.enter_context(progress("evaluating", total))
            if ray:
                results = results_on_ray(
                    found,
                    episodes,
                    on_cluster,
                    advance,
                    sim=sim,
                    sim_options=options,
                    seed=seed,
                    is_batched=is_batched,
                    max_steps=max_steps,
                    mask_from=source,
                )
                scores = {name: score_of(shown[name], results[name], env) for name in found}
                found = {}
            envs = make_sims(sim_name, episodes, **options) if is_batched and found else None
            recorder = None
            if log is not None:
                recorder = RecordMcap(
                    env, log, seed=seed, overwrite=overwrite, epsilon=0.0, keys=keys
                )
                stack.enter_context(closing(recorder))
            for name, candidates in found.items():
                recorded = recorder if name in given else None
                scores[name] = evaluate_policy(
                    recorded or env,
                    candidates,
                    name=shown[name],
                    episodes=episodes,
                    seed=seed,
                    envs=None if name in SCRIPTED else envs,
                    mask_from=source,
                    on_policy=partial(_set_policy, recorded),
                    on_episode=lambda result: advance(1),
                )
        for score in scores.values():
            warn_of_cuts(itertools.chain(*score.results), score.policy, sim_name)
    random, pilot = scores["random"], scores.get("pilot")
    normalized = [normalize(score, random, pilot) for score in scores.values()]
    if logged is not None:
        value = Scale.of(random, pilot).score(logged.mean_return)
        logged = replace(logged, normalized_score=None if math.isnan(value) else value)
    result = Evaluation(sim_name, seed, logged, tuple(normalized), tuple(improvements(normalized)))
    if folder is not None:
        _write_report(folder, result, world, None if log is None else (log, len(given)), paths)
    return result


def _policies(
    given: Mapping[str, str | BasePolicy], env: gym.Env[Any, Any]
) -> dict[str, list[BasePolicy]]:
    """Return a dict from names to policies; it includes `random` and, if there is one, `pilot`."""
    scripted = SCRIPTED if has_pilot(env) else ("random",)
    every = {**given, **dict(zip(scripted, scripted, strict=True))}
    return {name: policies_of(policy, env) for name, policy in every.items()}


def _set_policy(recorder: RecordMcap | None, name: str) -> None:
    if recorder is not None:
        recorder.policy = name


def _behavior(data: Data, env: gym.Env[Any, Any], record: Path | None) -> LoggedReturns:
    """Compute statistics of the returns in logs."""
    dataset, name = opened(data), named(data)
    if record is not None and record.resolve() in [path.resolve() for path in dataset.sources]:
        raise UsageError(f"{record} is in `behavior={name!r}`: record the episodes elsewhere")
    env_id = env.spec.id if env.spec else ""
    if not same_env(dataset.env_id, env_id):
        raise UsageError(
            f"`behavior={name!r}` was recorded in {dataset.env_id or 'unknown'}, not in {env_id}"
        )
    returns = dataset.statistics.returns
    interval = mean_interval(returns[None])
    return LoggedReturns(name, len(returns), float(returns.mean()), interval)


def _write_report(
    folder: Path,
    result: Evaluation,
    world: list[Any],
    log: tuple[Path, int] | None,
    names: Sequence[str],
) -> None:
    from mcaprl.sims.evaluation.report import evaluation_page

    write_json(folder / RESULT_NAME, result.to_json(), ReportError)
    logged = result.behavior
    band = None if logged is None else (logged.mean_return, *logged.interval)
    evaluation_page(
        folder,
        result.sim,
        list(result.policies),
        list(result.improvements),
        world,
        band,
        log,
        learning_curves([name for name in names if name not in SCRIPTED]),
    )


def learning_curves(names: Sequence[str]) -> list[Figure]:
    """Return the learning curves of runs; ignore names that do not belong to a run."""
    # Online runs share a figure; an offline run has one figure for each term of its loss.
    folders = dict.fromkeys(filter(None, (_run_folder(Path(name)) for name in names)))
    online = [folder for folder in folders if any(folder.glob("seed-*/curve.csv"))]
    figures = []
    if online:
        from mcaprl.online.curves import curve_figure, read_run

        runs = [read_run(folder) for folder in online]
        figures.append(Figure.of("Evaluations during training", curve_figure(runs, "")))
    for folder in folders:
        if folder in online:
            continue
        from mcaprl.offline.training.metrics import curve_panels

        figures += [
            Figure.of(f"{folder.name}: {panel.caption}", panel.figure())
            for panel in curve_panels(folder)
        ]
    return figures


def _run_folder(path: Path) -> Path | None:
    """Return the run folder to which a path belongs; None if it belongs to no run."""
    of_seed = [seed.parent for seed in (path, path.parent) if seed.name.startswith("seed-")]
    for folder in (path, *of_seed):
        if any(any(folder.glob(f"seed-*/{name}")) for name in ("curve.csv", "metrics.csv")):
            return folder
    return None
