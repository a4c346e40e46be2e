"""`mcaprl evaluate`: how good is a policy, and how sure is that."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import click
import gymnasium as gym

from mcaprl.cli.options import sim_options
from mcaprl.cli.policies import SCRIPTED, policies_of, policy_name
from mcaprl.cli.show import print_json, print_table, progress, write_json
from mcaprl.errors import UnknownNameError
from mcaprl.recorder.reader import open_logs
from mcaprl.recorder.wrapper import RecordMcap
from mcaprl.sims import make_sim
from mcaprl.sims.evaluate import PolicyScore, bootstrap_interval, normalize
from mcaprl.sims.evaluate import evaluate as evaluate_policy


@click.command()
@click.argument("policies", nargs=-1, required=True, metavar="POLICY...")
@click.option("--sim", required=True, help="lane, or any Gymnasium id.")
@click.option("--episodes", default=30, show_default=True, type=click.IntRange(1))
@click.option("--seed", default=1_000_000, show_default=True, type=click.IntRange(0))
@sim_options
@click.option("--behavior", metavar="DATA", help="Compare with the returns in these logs.")
@click.option("--record", "record_path", type=click.Path(path_type=Path), help="Log the episodes.")
@click.option("--report", type=click.Path(path_type=Path), help="Folder for pictures and JSON.")
@click.option("--overwrite", is_flag=True, help="Replace a log that is there.")
@click.option("--json", "as_json", is_flag=True, help="One JSON object on stdout.")
def evaluate(
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
    """Run each POLICY greedily through the same episodes of SIM.

    POLICY is pilot, random, or a trained run; of a run with several seeds all are scored. Scores
    are given beside random = 0 and pilot = 1, where the sim has a pilot.
    """
    logged = _behavior(behavior)
    env = make_sim(sim, **sim_arguments)
    with closing(env):
        world = list(getattr(env.unwrapped, "static_scene", list)())
        scores = _score_all(env, policies, episodes, seed, record_path, overwrite)
    result = {
        "sim": sim,
        "seed": seed,
        "behavior": logged and {"data": behavior, **logged},
        "policies": [score.to_json() for score in scores],
    }
    if report is not None:
        _write_report(report, result, scores, world)
    if as_json:
        print_json(result)
    else:
        _print_scores(sim, episodes, scores, logged)


def _score_all(
    env: gym.Env[Any, Any],
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
    runs = sum(len(found) for _, found in wanted + baselines)
    scores = {}
    with ExitStack() as stack:
        advance = stack.enter_context(progress("evaluating", runs * episodes))
        recorder = _recorder(env, record_path, seed, overwrite)
        if recorder is not None:
            stack.enter_context(closing(recorder))
        for name, found in wanted + baselines:
            acting = recorder if recorder is not None and name in names else env
            if isinstance(acting, RecordMcap):
                acting.policy, acting.epsilon = policy_name(name), 0.0
            scores[name] = evaluate_policy(
                acting,
                found,
                name=policy_name(name),
                episodes=episodes,
                seed=seed,
                on_episode=lambda result: advance(),
            )
    pilot = scores.get("pilot")
    return [normalize(score, scores["random"], pilot) for score in scores.values()]


def _baseline(name: str, env: gym.Env[Any, Any]) -> Any:
    try:
        return policies_of(name, env)
    except UnknownNameError:
        return None


def _recorder(
    env: gym.Env[Any, Any], path: Path | None, seed: int, overwrite: bool
) -> RecordMcap | None:
    return None if path is None else RecordMcap(env, path, seed=seed, overwrite=overwrite)


def _behavior(data: str | None) -> dict[str, Any] | None:
    """The logged episodes' mean return and its interval."""
    if data is None:
        return None
    returns = open_logs(data).statistics.returns
    low, high = bootstrap_interval(returns[None])
    return {
        "episodes": len(returns),
        "mean_return": float(returns.mean()),
        "interval": [low, high],
    }


def _write_report(
    folder: Path, result: dict[str, Any], scores: list[PolicyScore], world: list[Any]
) -> None:
    from mcaprl.sims.report import comparison_picture, trajectory_picture

    write_json(folder / "evaluation.json", result)
    logged = result["behavior"]
    band = None if logged is None else (logged["mean_return"], *logged["interval"])
    comparison_picture(folder / "comparison.png", scores, f"{result['sim']}: mean return", band)
    trajectory_picture(folder / "trajectories.png", scores, world)


def _print_scores(
    sim: str, episodes: int, scores: list[PolicyScore], logged: dict[str, Any] | None
) -> None:
    random = next((s.mean_return for s in scores if s.policy == "random"), math.nan)
    pilot = next((s.mean_return for s in scores if s.policy == "pilot"), math.nan)
    rows = []
    if logged is not None:
        score = (logged["mean_return"] - random) / (pilot - random or math.nan)
        rows.append(
            [
                "behavior, as logged",
                f"{logged['mean_return']:.2f}",
                _interval(logged["interval"]),
                "" if math.isnan(score) else f"{score:.3f}",
                f"{logged['episodes']} episodes",
            ]
        )
    rows += [
        [
            score.policy,
            f"{score.mean_return:.2f}",
            _interval(score.interval),
            "" if score.normalized_score is None else f"{score.normalized_score:.3f}",
            ", ".join(f"{count} {reason}" for reason, count in score.ends.items()),
        ]
        for score in scores
    ]
    print_table(
        f"{sim}: {episodes} episodes for each policy and training seed",
        ["policy", "mean return", "95 % interval", "random 0, pilot 1", "ends"],
        rows,
    )


def _interval(interval: Sequence[float]) -> str:
    return f"{interval[0]:.2f} to {interval[1]:.2f}"
