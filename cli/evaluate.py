"""`mcaprl evaluate`: how good is a policy, and how sure is that."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

import click
import gymnasium as gym

from mcaprl.api.policies import SCRIPTED, policies_of, policy_names
from mcaprl.cli.curves import learning_curves
from mcaprl.cli.off_policy import evaluate_from_log, print_estimates
from mcaprl.cli.options import sim_options
from mcaprl.cli.show import counted, print_json, print_table, progress
from mcaprl.errors import ReportError, UsageError, import_extra
from mcaprl.files import write_json
from mcaprl.recorder.dataset.open import find_logs, open_logs
from mcaprl.recorder.record.wrapper import RecordMcap
from mcaprl.sims import make_sim, make_sims
from mcaprl.sims.evaluation.evaluate import Improvement, PolicyScore, improvements, normalize
from mcaprl.sims.evaluation.evaluate import evaluate as evaluate_policy
from mcaprl.sims.evaluation.statistics import bootstrap_interval, interquartile_mean

RESULT_NAME = "evaluation.json"


@click.command()
@click.argument("policies", nargs=-1, required=True, metavar="POLICY...")
@click.option("--sim", help="lane, powerline, racer, highway-lane, or any Gymnasium id.")
@click.option("--data", help="Estimate from these logs alone, instead of running a sim.")
@click.option("--episodes", default=30, show_default=True, type=click.IntRange(1))
@click.option("--seed", default=1_000_000, show_default=True, type=click.IntRange(0))
@sim_options
@click.option("--gamma", type=click.FloatRange(0, 1), help="With --data: discount. [default: 0.97]")
@click.option(
    "--epsilon",
    type=click.FloatRange(0, 1),
    help="With --data: probability of a random action instead of the policy's.  [default: 0]",
)
@click.option(
    "--updates",
    type=click.IntRange(1),
    help="With --data: gradient steps of the model.  [default: 10000]",
)
@click.option(
    "--threads",
    type=click.IntRange(1),
    help="With --data: that read chunks at a time. [default: 1]",
)
@click.option("--behavior", metavar="DATA", help="Compare with the returns in these logs.")
@click.option("--record", "record_path", type=click.Path(path_type=Path), help="Log the episodes.")
@click.option("--report", type=click.Path(path_type=Path), help="Folder for a page and more.")
@click.option("--overwrite", is_flag=True, help="Replace a log that is there.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout.")
def evaluate(
    policies: tuple[str, ...],
    sim: str | None,
    data: str | None,
    seed: int,
    as_json: bool,
    **others: Any,
) -> None:
    """Run each POLICY greedily through the same episodes of SIM, or ask the logs DATA about it.

    POLICY is pilot, random, or a trained run; of a run with several seeds all are scored. Scores
    are given beside random = 0 and pilot = 1, where the sim has a pilot. Without a sim the values
    are estimates of discounted returns, each with a verdict on whether the logs suffice for it.
    """
    if (sim is None) == (data is None):
        raise UsageError("evaluate needs --sim SIM or --data DATA, one of the two")
    of_data = {name: others.pop(name) for name in ("gamma", "epsilon", "updates", "threads")}
    _refuse_unused(of_data if data is None else others, "data" if data is None else "sim")
    if data is not None:
        given = {name: value for name, value in of_data.items() if value is not None}
        result = evaluate_from_log(policies, data, seed=seed, **given)
        print_json(result) if as_json else print_estimates(result)
        return
    assert sim is not None
    _evaluate_in_sim(policies, sim, seed=seed, as_json=as_json, **others)


def _refuse_unused(options: dict[str, Any], needs: str) -> None:
    for name, value in options.items():
        if value and name != "episodes":
            raise UsageError(f"--{name.removesuffix('_path')} is of use with --{needs} only")


def _evaluate_in_sim(
    policies: tuple[str, ...],
    sim: str,
    episodes: int,
    seed: int,
    sim_arguments: dict[str, Any],
    behavior: str | None,
    record_path: Path | None,
    report: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    env = make_sim(sim, **sim_arguments)
    with closing(env):
        # What can be wrong is looked for first: episodes may take minutes.
        logged = _behavior(behavior, env, record_path)
        if report is not None:
            import_extra("matplotlib", "report")
            import_extra("jinja2", "report")
            write_json(report / RESULT_NAME, {}, ReportError)
        world = list(getattr(env.unwrapped, "static_scene", list)())
        envs = None
        if env.spec is not None and env.spec.vector_entry_point and record_path is None:
            envs = make_sims(sim, episodes, **sim_arguments)
        scores = _score_all(env, envs, policies, episodes, seed, record_path, overwrite)
    if logged is not None:
        logged = _scaled(logged, scores)
    compared = improvements(scores)
    result = {
        "sim": sim,
        "seed": seed,
        "behavior": logged,
        "policies": [score.to_json() for score in scores],
        "improvements": [improvement.to_json() for improvement in compared],
    }
    if as_json:
        print_json(result)
    else:
        _print_scores(sim, episodes, scores, logged)
        _print_improvements(compared)
    if report is not None:
        recorded = None if record_path is None else (record_path, len(set(policies)))
        _write_report(report, result, scores, compared, world, recorded, policies)


def _score_all(
    env: gym.Env[Any, Any],
    envs: gym.vector.VectorEnv[Any, Any, Any] | None,
    names: Sequence[str],
    episodes: int,
    seed: int,
    record_path: Path | None,
    overwrite: bool,
) -> list[PolicyScore]:
    """Score what was asked for, then what it is measured against; only the former is recorded."""
    wanted = [(name, policies_of(name, env)) for name in dict.fromkeys(names)]
    baselines = [
        (name, found)
        for name in SCRIPTED
        if name not in names and (found := _baseline(name, env)) is not None
    ]
    shown = policy_names([name for name, _ in wanted + baselines])
    runs = sum(len(found) for _, found in wanted + baselines)
    scores = {}
    with ExitStack() as stack:
        advance = stack.enter_context(progress("evaluating", runs * episodes))
        recorder = None
        if record_path is not None:
            recorder = RecordMcap(env, record_path, seed=seed, overwrite=overwrite, epsilon=0.0)
            stack.enter_context(closing(recorder))
        for name, found in wanted + baselines:
            recorded = recorder if name in names else None
            scores[name] = evaluate_policy(
                recorded or env,
                found,
                name=shown[name],
                episodes=episodes,
                seed=seed,
                envs=None if name in SCRIPTED else envs,
                on_policy=partial(_tell_policy, recorded),
                on_episode=lambda result: advance(),
            )
    pilot = scores.get("pilot")
    return [normalize(score, scores["random"], pilot) for score in scores.values()]


def _tell_policy(recorder: RecordMcap | None, name: str) -> None:
    if recorder is not None:
        recorder.policy = name


def _baseline(name: str, env: gym.Env[Any, Any]) -> Any:
    try:
        return policies_of(name, env)
    except UsageError:
        return None


def _behavior(
    data: str | None, env: gym.Env[Any, Any], record_path: Path | None
) -> dict[str, Any] | None:
    """The logged episodes' mean return and its interval.

    Raises:
        UsageError: the logs are of another environment, or about to be overwritten.
    """
    if data is None:
        return None
    if record_path is not None and record_path.resolve() in [p.resolve() for p in find_logs(data)]:
        raise UsageError(f"{record_path} is in --behavior {data}: record the episodes elsewhere")
    dataset = open_logs(data)
    env_id = env.spec.id if env.spec else ""
    if dataset.env_id != env_id:
        raise UsageError(f"--behavior {data} is of {dataset.env_id or 'unknown'}, not of {env_id}")
    returns = dataset.statistics.returns
    return {
        "data": data,
        "episodes": len(returns),
        "mean_return": float(returns.mean()),
        "interval": list(bootstrap_interval(returns[None])),
    }


def _scaled(logged: dict[str, Any], scores: list[PolicyScore]) -> dict[str, Any]:
    """The logged behavior with its place between random and pilot."""
    random = next((s.mean_return for s in scores if s.policy == "random"), math.nan)
    pilot = next((s.mean_return for s in scores if s.policy == "pilot"), math.nan)
    score = (logged["mean_return"] - random) / (pilot - random or math.nan)
    return {**logged, "normalized_score": None if math.isnan(score) else score}


def _write_report(
    folder: Path,
    result: dict[str, Any],
    scores: list[PolicyScore],
    compared: list[Improvement],
    world: list[Any],
    recorded: tuple[Path, int] | None,
    names: Sequence[str],
) -> None:
    from mcaprl.sims.evaluation.report import evaluation_page

    write_json(folder / RESULT_NAME, result, ReportError)
    logged = result["behavior"]
    band = None if logged is None else (logged["mean_return"], *logged["interval"])
    curves = learning_curves([name for name in names if name not in SCRIPTED])
    evaluation_page(folder, result["sim"], scores, compared, world, band, recorded, curves)


def _print_scores(
    sim: str, episodes: int, scores: list[PolicyScore], logged: dict[str, Any] | None
) -> None:
    rows = []
    if logged is not None:
        rows.append(
            [
                "behavior, as logged",
                f"{logged['mean_return']:.2f}",
                _interval(logged["interval"]),
                "",
                _score(logged["normalized_score"]),
                "",
                counted(logged["episodes"], "episode"),
            ]
        )
    rows += [
        [
            score.policy,
            f"{score.mean_return:.2f}",
            _interval(score.interval),
            f"{float(interquartile_mean(score.returns)):.2f}",
            _score(score.normalized_score),
            "" if score.success_rate is None else f"{score.success_rate:.0%}",
            ", ".join(f"{count} {reason}" for reason, count in score.ends.items()),
        ]
        for score in scores
    ]
    print_table(
        f"{sim}: {counted(episodes, 'episode')} for each policy and training seed",
        [
            "policy",
            "mean return",
            "95 % interval",
            "middle half",
            "random 0, pilot 1",
            "success",
            "ends",
        ],
        rows,
    )


def _print_improvements(compared: list[Improvement]) -> None:
    print_table(
        "how often an episode of one returns more than an episode of the other",
        ["policy", "than", "probability", "95 % interval"],
        [
            [one.better, one.than, f"{one.probability:.2f}", _interval(one.interval)]
            for one in compared
        ],
    )


def _interval(interval: Sequence[float]) -> str:
    return f"{interval[0]:.2f} to {interval[1]:.2f}"


def _score(score: float | None) -> str:
    return "" if score is None else f"{score:.3f}"
