"""`mcaprl evaluate`: returns of policies, measured in a sim or estimated from logs."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

import mcaprl
from mcaprl.cli.completion import Name, policies, sims
from mcaprl.cli.help import Command
from mcaprl.cli.options import (
    bag_options,
    integer_option,
    json_option,
    keys_option,
    mapping_options,
    max_steps_option,
    ray_options,
    selection_options,
    sim_options,
    trust_run_option,
)
from mcaprl.cli.progress import keeping, working
from mcaprl.cli.show import echo, print_json, print_table
from mcaprl.errors import UsageError
from mcaprl.page import PAGE_NAME
from mcaprl.texts import counted

if TYPE_CHECKING:
    from mcaprl.api.action_errors import ActionErrors
    from mcaprl.api.estimate import LogEstimates
    from mcaprl.api.evaluate import Evaluation
    from mcaprl.offline.estimate.off_policy import Estimate

_OF_DATA = (
    "gamma",
    "epsilon",
    "updates",
    "estimate_behavior",
    "clip_actions",
    "threads",
    "mapping",
    "trust_code",
    "definitions",
    "report",
    "only",
    "mask",
)


@click.command(cls=Command)
@click.argument(
    "policies", nargs=-1, required=True, metavar="POLICY...", type=Name(policies, is_path=True)
)
@click.option(
    "--sim", type=Name(sims), help="lane, powerline, racer, highway-lane, or any Gymnasium id."
)
@click.option(
    "--data", help="Logs to estimate returns from and to compare actions with, instead of --sim."
)
@click.option(
    "--episodes",
    type=click.IntRange(1),
    help="Number of episodes for each policy and training seed.  [default: 30]",
)
@max_steps_option
@integer_option(
    "--seed",
    "Seed of the episodes; with --data, seed of the model and of the resampling.",
    least=0,
    default=1_000_000,
)
@sim_options
@trust_run_option
@click.option("--gamma", type=click.FloatRange(0, 1), help="With --data: discount. [default: 0.97]")
@click.option(
    "--epsilon",
    type=click.FloatRange(0, 1),
    help="With --data: probability of a random action instead of the policy's.  [default: 0]",
)
@click.option(
    "--updates",
    type=click.IntRange(1),
    help="With --data: number of gradient steps of a model.  [default: 10000; for a Box, 3000]",
)
@click.option(
    "--estimate-behavior",
    is_flag=True,
    default=None,
    help="With --data: estimate behavior_prob or behavior_log_prob from the actions, for logs"
    " without it.",
)
@click.option(
    "--clip-actions",
    is_flag=True,
    default=None,
    help="With --data: clip logged actions outside a Box to its bounds; otherwise, they are an"
    " error.",
)
@click.option(
    "--threads",
    type=click.IntRange(1),
    help="With --data: number of threads of PyTorch and of the reader.  [default: 1]",
)
@click.option(
    "--all",
    "shows_all",
    is_flag=True,
    help="With --data: print the table of all estimators, with their verdicts.",
)
@selection_options
@mapping_options
@click.option("--behavior", metavar="DATA", help="Logs whose returns are shown for comparison.")
@click.option("--record", type=click.Path(path_type=Path), help="Log to write.")
@keys_option
@click.option("--report", type=click.Path(path_type=Path), help="Output folder of the HTML report.")
@click.option("--overwrite", is_flag=True, help="Replace an existing log.")
@click.option(
    "--mask-from",
    metavar="SOURCE",
    help="With --sim: flags of the allowed actions, for random actions: info:NAME, or a key of the"
    " observation.  [default: that of the trained policies]",
)
@ray_options
@json_option
def evaluate(
    policies: tuple[str, ...],
    sim: str | None,
    data: str | None,
    seed: int,
    shows_all: bool,
    as_json: bool,
    **others: Any,
) -> None:
    """Evaluate each POLICY on the same episodes of SIM, or estimate its return from logs.

    POLICY is pilot, random, or a trained run; each seed of a run is evaluated. Actions are greedy.
    With --data, it can also be an ONNX file, a Python function MODULE:FUNCTION (with --trust-code),
    or a folder with episode-K.npy: its actions are compared with the logged ones.
    If the sim has a pilot, scores are normalized: the score of random is 0, and the score of pilot
    is 1. With --data, discounted returns are estimated: one line for each policy says what it is
    worth beside the log, how sure that is, and what to do next. --all shows all estimators, with
    verdicts whether the logs suffice. For the actions of a Box, policies are ordered by FQE, which
    is refused if it is wrong about the behavior of the logs.
    """
    given = {name: value for name, value in others.items() if value}
    if data is not None and sim is None:
        _refuse_unused(given, [name for name in others if name not in _OF_DATA], "sim")
        # Compare with None, because 0 is a valid value of these options.
        bag, report = bag_options(others), others.pop("report")
        selection = {name: others.pop(name) for name in ("only", "mask")}
        given = {name: others[name] for name in _OF_DATA if others.get(name) is not None}
        with working("reading data") as bar:
            from mcaprl.api.action_errors import is_estimable

            read = {"threads": others["threads"] or 1} if bag["mapping"] is None else bag
            source = mcaprl.select(mcaprl.open(data, **read), **selection)
            errors = mcaprl.action_errors(
                policies, source, trust_code=bag["trust_code"], seed=seed, report=report
            )
            known = [one for one in policies if is_estimable(one, source)]
            estimates = None
            if known:
                estimates = mcaprl.estimate(known, source, seed=seed, progress=bar, **given)
        if as_json:
            values = {} if estimates is None else {**estimates.to_json(), "data": data}
            print_json({**values, "action_errors": {**errors.to_json(), "data": data}})
            return
        if estimates is not None:
            _print_answers(replace(estimates, data=data))
            if shows_all:
                _print_estimates(estimates)
        _print_errors(errors)
        if report is not None:
            echo(f"report: {report / PAGE_NAME}")
    elif sim is not None and data is None:
        _refuse_unused(given, [name for name in _OF_DATA if name != "report"], "data")
        kept = nullcontext() if others["record"] is None else keeping("finished episodes are kept")
        with kept, working("loading the sim and the policies") as bar:
            found = mcaprl.evaluate(policies, sim, seed=seed, progress=bar, **given)
        if as_json:
            print_json(found.to_json())
            return
        _print_scores(found)
        if others["report"] is not None:
            echo(f"report: {others['report'] / PAGE_NAME}")
        if others["record"] is not None:
            echo(f"log: {others['record']}")
    else:
        raise UsageError("evaluate needs either --sim SIM or --data DATA")


def _print_errors(found: ActionErrors) -> None:
    for one in found.policies:
        title = f"action error of {one.policy}: {counted(one.episodes, 'episode')}, {one.why}"
        print_table(title, *found.rows(one))
        for line in one.lines():
            echo(line)
    echo(found.caveat)


def _refuse_unused(given: dict[str, Any], names: Sequence[str], needed: str) -> None:
    for name in names:
        if name in given:
            raise UsageError(f"`{name}=` requires --{needed}")


def _print_scores(found: Evaluation) -> None:
    rows = _score_rows(found)
    # Discrete actions have no change of the command, and most environments no pilot.
    columns = [name for name in rows[-1] if any(row.get(name) is not None for row in rows)]
    episodes = found.policies[0].returns.shape[1]
    print_table(
        f"{found.sim}: {counted(episodes, 'episode')} for each policy and training seed",
        columns,
        [[row.get(name) or "" for name in columns] for row in rows],
    )
    if not all(score.has_interval for score in found.policies):
        echo("no interval of 2 seeds, which have one difference only: train 3 seeds or more")
    if not found.improvements:
        return
    print_table(
        "probability that an episode of one policy has a higher return than an episode of another",
        ["policy", "than", "probability", "95 % interval"],
        [
            [one.better, one.than, f"{one.probability:.2f}", _interval(one.interval)]
            for one in found.improvements
        ],
    )


def _score_rows(found: Evaluation) -> list[dict[str, str | None]]:
    """Return the cells of the table by column, for the behavior in a log and for each policy."""
    from mcaprl.sims.evaluation.evaluate import interquartile_mean

    rows: list[dict[str, str | None]] = []
    if (logged := found.behavior) is not None:
        rows.append(
            {
                "policy": "behavior, as logged",
                "mean return": f"{logged.mean_return:.2f}",
                "95 % interval": _interval(logged.interval),
                "random 0, pilot 1": _score(logged.normalized_score),
                "ends": counted(logged.episodes, "episode"),
            }
        )
    for score in found.policies:
        rate, change = score.success_rate, score.command_change
        rows.append(
            {
                "policy": score.policy,
                "mean return": f"{score.mean_return:.2f}",
                "95 % interval": _interval(score.interval) if score.has_interval else "2 seeds",
                "IQM": f"{float(interquartile_mean(score.returns)):.2f}",
                "random 0, pilot 1": _score(score.normalized_score),
                "success": None if rate is None else f"{rate:.0%}",
                "ends": ", ".join(f"{count} {reason}" for reason, count in score.ends.items()),
                "change a step": None if change is None else f"{change:.3g}",
            }
        )
    return rows


def _print_answers(found: LogEstimates) -> None:
    """Print what each policy is worth, and their order if the log supports one."""
    echo(
        f"{found.data}: {counted(found.episodes, 'episode')}, mean return discounted by"
        f" {found.gamma}: {found.behavior_return:.3f} ({_interval(found.behavior_interval, 3)})"
    )
    for policy, answer in found.answers().items():
        echo(f"{policy}: {answer}")
    if (order := found.ranking) is not None and found.is_ranked:
        echo(f"best first, by {order['estimator']}: {', '.join(order['policies'])}")
        if order["close"]:
            echo(f"within the noise of FQE's seeds of the first: {', '.join(order['close'])}")


def _print_estimates(found: LogEstimates) -> None:
    title = "all estimators"
    if found.behavior_check is None:
        _print_rows(title, found.estimates)
    else:
        by_model = [one for one in found.estimates if one.estimator == "FQE"]
        _print_rows(title, sorted(by_model, key=lambda one: -(one.value or 0.0)))
        echo(f"{found.behavior_check}")
        weighted = [one for one in found.estimates if one.estimator != "FQE"]
        _print_rows("importance sampling, of actions drawn from the densities", weighted)
    if found.coverage:
        coverage = ", ".join(f"{share:.0%} by {name}" for name, share in found.coverage.items())
        echo(f"logged actions that the policies would take: {coverage}")
    if found.support:
        support = ", ".join(f"{share:.0%} of {name}" for name, share in found.support.items())
        echo(f"actions as near to logged ones as 95 % of the log's own: {support}")
    if (estimated := found.behavior_estimate) is not None:
        echo(f"estimated {estimated.dataset.behavior_field.name}: {estimated}")
    if found.behavior_calibration is not None:
        echo(f"behavior_prob of the logs implies {found.behavior_calibration}")


def _print_rows(title: str, estimates: Sequence[Estimate]) -> None:
    """Print the estimates, without the columns that none of them has."""
    rows = [
        {
            "policy": one.policy,
            "estimator": one.estimator,
            "value": "" if one.value is None else f"{one.value:.3f}",
            "spread": "" if one.spread is None else f"{one.spread:.3f}",
            "95 % interval": "" if one.interval is None else _interval(one.interval, 3),
            "effective episodes": ""
            if one.effective_sample_size is None
            else f"{one.effective_sample_size:.1f}",
            "verdict": one.verdict,
        }
        for one in estimates
    ]
    missing = [name for name in ("spread", "effective episodes") if not any(r[name] for r in rows)]
    columns = [name for name in rows[0] if name not in missing]
    print_table(title, columns, [[row[name] for name in columns] for row in rows])


def _interval(interval: Sequence[float], digits: int = 2) -> str:
    return f"{interval[0]:.{digits}f} to {interval[1]:.{digits}f}"


def _score(score: float | None) -> str | None:
    return None if score is None else f"{score:.3f}"
