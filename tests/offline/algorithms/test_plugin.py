"""Tests of an algorithm in another package, which is found by its entry point."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from mcaprl.api.policies import load_policy
from mcaprl.cli import run
from mcaprl.errors import UnknownNameError, UsageError
from mcaprl.offline.algorithms.registry import ALGORITHMS, all_algorithms, choose_algorithm
from mcaprl.offline.training.train import train
from tests.support.offline_tasks import corridor, inner_observations

# Steps 1 and 2: define a config and a loss. The package contains nothing else.
MODULE = '''
from dataclasses import dataclass

from torch.nn import functional

from mcaprl.offline.algorithms.config import TrainingConfig
from mcaprl.offline.algorithms.learner import Learner


@dataclass(frozen=True)
class SmoothedConfig(TrainingConfig):
    """Settings of cloning with label smoothing."""

    smoothing: float = 0.1
    """fraction of the probability that is spread over all actions"""


class Smoothed(Learner):
    """Behavior cloning with label smoothing."""

    name = "smoothed-bc"
    config_type = SmoothedConfig
    acts_by = "logits"
    policy_models = ("logits",)

    def output_shapes(self):
        return {"logits": (self.n_actions,)}

    def losses(self, batch):
        logits = self.outputs("logits", batch.observations)
        loss = functional.cross_entropy(
            logits, batch.actions, reduction="none", label_smoothing=self.config.smoothing
        )
        return {"loss": loss}
'''
# Step 3: register the algorithm by an entry point.
ENTRY_POINT = "smoothed-bc = smoothed_bc_package:Smoothed"
FEW = ["--updates", "300", "--batch-size", "32", "--hidden", "16", "--learning-rate", "0.01"]


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, entry_point: str) -> None:
    """Install a package into a folder on the import path, as pip does."""
    (folder / "smoothed_bc_package.py").write_text(MODULE)
    info = folder / "smoothed_bc-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: smoothed-bc\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[mcaprl.algorithms]\n{entry_point}\n")
    monkeypatch.syspath_prepend(folder)


def test_an_installed_algorithm_trains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, monkeypatch, ENTRY_POINT)
    log, mostly_right = tmp_path / "log.mcap", {(cell, 1): 9 for cell in (1, 2, 3)}
    data = corridor(mostly_right | {(cell, 0): 1 for cell in (1, 2, 3)})
    data.save(log)
    # Step 4: train with the algorithm from Python (by name or config) and from the command line.
    learner_type, defaults = choose_algorithm("smoothed-bc")
    config = replace(defaults, updates=300, hidden=(16,), learning_rate=0.01)
    assert choose_algorithm(config) == (learner_type, config)
    train(data, config, tmp_path / "python", progress=lambda _: None)
    options = ["--algo", "smoothed-bc", "--smoothing", "0.2", *FEW]
    assert run(["train-offline", str(log), "--out", str(tmp_path / "cli"), *options]) == 0
    start = int(data.action_space.start)  # type: ignore[attr-defined]
    for name in ("python", "cli"):
        policy = load_policy(tmp_path / name)
        assert policy.algo == "smoothed-bc"
        assert (policy.act(inner_observations()) == start + 1).all()


@pytest.mark.parametrize(
    ("entry_point", "reason"),
    [
        ("smoothed-bc = no_such_module:Smoothed", "ModuleNotFoundError: No module named"),
        ("smoothed-bc = smoothed_bc_package:Missing", "AttributeError: "),
        ("smoothed-bc = smoothed_bc_package:SmoothedConfig", "it is not a subclass of Learner"),
        ("other = smoothed_bc_package:Smoothed", "its name is 'smoothed-bc'"),
        ("cql = mcaprl.offline.algorithms.cql:CQL", "the name is built in"),
    ],
)
def test_a_broken_entry_point_is_one_line_that_names_it(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    entry_point: str,
    reason: str,
) -> None:
    install(tmp_path, monkeypatch, entry_point)
    name = entry_point.split()[0]
    with pytest.raises(
        UsageError, match=f"entry point '{name}' .* of package smoothed-bc"
    ) as error:
        all_algorithms()
    assert reason in str(error.value)
    # Built-in algorithms do not load the entry point.
    assert choose_algorithm("bc")[0] is ALGORITHMS["bc"]
    assert run(["train-offline", "log.mcap", "--out", "run"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"entry point '{name}'" in line
    assert reason in line


def test_an_installed_algorithm_is_suggested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path, monkeypatch, ENTRY_POINT)
    with pytest.raises(UnknownNameError, match="did you mean smoothed-bc"):
        choose_algorithm("smooth-bc")
