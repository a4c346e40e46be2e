"""Tests of the tables of the studies in `benchmarks`: regrets and differences by hand."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from benchmarks.studies import selection, sim_grid
from benchmarks.studies.selection import CHECKPOINT_RULES, Log, rules
from benchmarks.studies.sim_data import log_names


def row(candidate: str, kind: str = "full", seed: int = 0, **labels: Any) -> dict[str, Any]:
    return {"candidate": candidate, "kind": kind, "seed": seed, **labels}


def log(entropy: float = 0.5) -> Log:
    """Return a log on which CQL has the better last checkpoint, and BC the better first one."""
    evidence = {
        ("cql", "full"): {"own_value": 3.0, "first_value": 1.0, "agreement": 0.5},
        ("cql", "short"): {"own_value": 2.0, "first_value": 2.0, "agreement": 0.8},
        ("bc", "full"): {"own_value": None, "first_value": 4.0, "agreement": 0.9},
        ("bc", "short"): {"own_value": None, "first_value": 5.0, "agreement": 0.4},
    }
    rows = [row(name, kind, pessimistic=one) for (name, kind), one in evidence.items()]
    losses = {"bvft_own": 0.4, "sbv_own": 0.1, "bvft_fqe": 0.3, "sbv_fqe": 0.3}
    rows.append(row("cql", tournament=losses))
    rows.append(row("bc", tournament={"bvft_fqe": 0.1, "sbv_fqe": 0.5}))
    rows.append(row("bc", seed=1, tournament={}))
    return Log("lane", "weak", entropy, {"cql": 0.9, "bc": 0.5}, {"cql": 0.3, "bc": 0.6}, rows)


def test_rules_of_q_functions_choose_the_smallest_loss() -> None:
    table = rules(["cql", "bc"])
    found = {name: rule(log()) for name, rule in table.items() if name.startswith(("BVFT", "SBV"))}
    assert found == {
        "BVFT, own Q": "cql",
        "BVFT, FQE's Q": "bc",
        "SBV, own Q": "cql",
        "SBV, FQE's Q": "cql",
    }
    assert log().regret(table["BVFT, FQE's Q"]) == pytest.approx(0.4)
    assert log().regret(table["always cql"]) == 0


@pytest.mark.parametrize(
    ("rule", "entropy", "regret"),
    [
        # The last checkpoint of BC scores .1 less than its first one; that of CQL is the better.
        ("last checkpoint", 0.5, (0 + 0.1) / 2),
        ("first checkpoint", 0.5, (0.6 + 0) / 2),
        # BC has no values, so its last checkpoint is used.
        ("largest own Q", 0.5, (0 + 0.1) / 2),
        ("pessimistic FQE, first states", 0.5, (0.6 + 0) / 2),
        ("agreement with the behavior", 0.5, (0.6 + 0.1) / 2),
        ("auto", 0.5, (0.6 + 0) / 2),
        ("auto", 0.01, (0.6 + 0.1) / 2),
    ],
)
def test_regrets_of_checkpoints_by_hand(rule: str, entropy: float, regret: float) -> None:
    assert log(entropy).checkpoint_regret(CHECKPOINT_RULES[rule]) == pytest.approx(regret)


def test_two_ranks_choose_the_candidate_that_is_good_by_both() -> None:
    """BC is second by value and first by loss: 1 + 2 ranks. The others have 2 + 0 and 0 + 1."""
    found = {"cql": (3.0, 0.9), "bc": (2.0, 0.1), "iql": (1.0, 0.5)}
    rows = [
        row(name, pessimistic={"mean_value": value}, tournament={"sbv_fqe": loss})
        for name, (value, loss) in found.items()
    ]
    scores = dict.fromkeys(found, 0.0)
    table = rules(found)
    assert (
        table["ranks of pessimistic FQE and SBV"](Log("lane", "x", 0.5, scores, {}, rows)) == "bc"
    )


def test_saved_logs_have_the_same_regrets() -> None:
    saved = Log(**json.loads(json.dumps(log().summary())))
    assert len(saved.rows) == 4
    names = ("BVFT, FQE's Q", "largest own Q", "pessimistic FQE, first states", "always cql")
    for name in names:
        rule = rules(["cql", "bc"])[name]
        assert saved.regret(rule) == log().regret(rule)
    for name, choose in CHECKPOINT_RULES.items():
        expected = log().checkpoint_regret(choose)
        assert saved.checkpoint_regret(choose) == pytest.approx(expected), name


def test_iql_is_a_candidate_and_all_environments_have_logs() -> None:
    assert "iql" in selection.CANDIDATES
    assert {"lane", "powerline", "racer", "CartPole-v1", "Acrobot-v1"} == set(sim_grid.SETTINGS)
    assert log_names("lane") == [*log_names("CartPole-v1"), "weak"]


def test_settings_are_compared_on_logs_that_have_both() -> None:
    def cell(score: float) -> dict[str, Any]:
        return {"score": score, "interval": [score - 0.1, score + 0.1]}

    behavior = {"behavior": {"score": 0.2, "transitions": 10}}
    cells = {
        "lane": {
            "weak": {**behavior, "cql": cell(0.1), "cql, scaled": cell(0.4)},
            "expert": {**behavior, "cql": cell(0.9)},
        }
    }
    lines = sim_grid.study_table(cells).splitlines()
    rows = {line.split(" | ")[0][2:]: line.strip("| ").split(" | ")[1:] for line in lines[2:]}
    assert rows["lane weak (0.20)"][:3] == [
        "0.10 (0.00 to 0.20)",
        "0.40 (0.30 to 0.50)",
        "-",
    ]
    assert rows["mean"][:3] == ["0.50 (0.10 to 0.90; n = 2)", "0.40 (0.40 to 0.40; n = 1)", "-"]
    assert rows["minus the first column"][1] == "0.30 (0.30 to 0.30; n = 1)"


def test_the_target_gap_is_above_the_entropy_of_the_behavior() -> None:
    class Data:
        behavior_probs = np.array([0.5, 0.25], np.float32)

    data: Any = Data()
    entropy = (np.log(2) + np.log(4)) / 2
    assert sim_grid.above_entropy(data)["target_gap"] == pytest.approx(entropy + 0.2)
