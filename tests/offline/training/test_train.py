"""Tests of training runs: the files of a run folder, also after a stop or a kill."""

from __future__ import annotations

import csv
import json
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from mcaprl.errors import OutputExistsError, SpaceError, TrainingError, UnknownNameError, UsageError
from mcaprl.offline.algorithms.config import (
    BCConfig,
    BCQConfig,
    CQLConfig,
    DoubleDQNConfig,
    DQNConfig,
    IQLConfig,
)
from mcaprl.offline.policy import read_policy
from mcaprl.offline.training.metrics import OfflineSummary, describe_seeds, draw_curves
from mcaprl.offline.training.train import train
from mcaprl.progress import Pause, TrainingProgress
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.runs import read_curve
from tests.support.offline_tasks import corridor, crossing
from tests.support.paths import ROOT

SHORT: dict[str, Any] = {
    "updates": 100,
    "batch_size": 16,
    "hidden": (16,),
    "log_interval": 10,
    "checkpoint_interval": 40,
}
SHORT_CQL = CQLConfig(**SHORT, target_interval=30, gamma=0.5)


LATE = {**SHORT, "gamma": 0.5, "target_interval": 30}
RESUMABLE = [
    SHORT_CQL,
    replace(SHORT_CQL, n_steps=2, frame_stack=2, normalize=True, n_quantiles=3, weight_decay=0.1),
    replace(SHORT_CQL, target_gap=0.7, alpha=0.5, scale_rewards=True),
    DQNConfig(**LATE, dueling=True, layer_norm=True),
    BCQConfig(**LATE),
    IQLConfig(**LATE),
    BCConfig(**SHORT),
]


class Stopped(Exception):
    """Exception that a callback raises to stop the training, like Ctrl-C."""


class StopAt:
    """A progress callback that stops the training after an update."""

    def __init__(self, update: int) -> None:
        self.update = update

    def __call__(self, now: TrainingProgress) -> None:
        if now.done == self.update:
            raise Stopped


def silent(_: TrainingProgress) -> None:
    """A progress callback that does nothing."""


def rows(run: Path, seed: int = 0) -> list[dict[str, str]]:
    with (run / f"seed-{seed}" / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def assert_same_result(run: Path, expected: Path, seed: int = 0) -> None:
    """Check that weights, optimizer moments, generators and metrics are equal bit for bit."""
    for name in ("policy.safetensors", "checkpoint.safetensors"):
        found, wanted = (load_file(folder / f"seed-{seed}" / name) for folder in (run, expected))
        assert found.keys() == wanted.keys()
        assert all(torch.equal(found[key], tensor) for key, tensor in wanted.items())
    curves = [(folder / f"seed-{seed}" / "metrics.csv").read_bytes() for folder in (run, expected)]
    assert curves[0] == curves[1]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> OfflineSummary:
    """Train with SHORT_CQL and return the summary; tests do not change the folder."""
    out = tmp_path_factory.mktemp("whole") / "run"
    (summary,) = train(corridor(), SHORT_CQL, out, progress=silent)
    return summary


@pytest.fixture
def copied(whole: OfflineSummary, tmp_path: Path) -> Path:
    """Return the folder of a copy of this run."""
    return shutil.copytree(whole.folder.parent, tmp_path / "run")


def test_a_run_folder_has_settings_policy_checkpoint_and_curve(whole: OfflineSummary) -> None:
    summary, run = whole, whole.folder.parent
    assert summary.folder.name == "seed-0"
    assert (summary.algo, summary.seed, summary.steps, summary.resumed_at) == ("cql", 0, 100, 0)
    assert summary.seconds > 0
    names = {path.name for path in summary.folder.iterdir()}
    assert names > {"policy.json", "policy.safetensors", "checkpoint.safetensors", "metrics.csv"}
    assert not any(name.endswith(".tmp") for name in names)
    settings = json.loads((run / "config.json").read_text())
    assert settings["algo"] == "cql"
    assert settings["config"]["alpha"] == 1.0
    assert settings["config"]["hidden"] == [16]
    assert settings["data"] == corridor().fingerprint
    assert settings["env_id"] == "Corridor-v0"


def test_the_curve_names_the_terms_of_the_loss(whole: OfflineSummary) -> None:
    curve = rows(whole.folder.parent)
    assert [int(row["update"]) for row in curve] == list(range(10, 101, 10))
    assert {"learning_rate", "loss", "td_loss", "conservative_penalty", "mean_q"} < curve[0].keys()
    for row in curve:
        total = float(row["td_loss"]) + float(row["conservative_penalty"])
        assert float(row["loss"]) == pytest.approx(total, abs=1e-5)
    assert float(curve[-1]["learning_rate"]) == pytest.approx(0.02 * 1e-3)
    assert float(curve[-1]["loss"]) == whole.terms["loss"]


def test_tensorboard_shows_the_same_curve(whole: OfflineSummary) -> None:
    events = EventAccumulator(str(whole.folder))
    events.Reload()
    shown = {event.step: event.value for event in events.Scalars("train/loss")}
    written = {int(row["update"]): float(row["loss"]) for row in rows(whole.folder.parent)}
    assert shown == pytest.approx(written)


def test_progress_is_reported_at_each_log_interval(tmp_path: Path) -> None:
    reported: list[TrainingProgress] = []
    train(corridor(), SHORT_CQL, tmp_path / "run", progress=reported.append)
    assert [now.done for now in reported] == list(range(10, 101, 10))
    assert all(now.total == 100 and now.terms["loss"] > 0 for now in reported)


@pytest.mark.parametrize(
    "config",
    [DQNConfig(**SHORT, gamma=0.5), DoubleDQNConfig(**SHORT, gamma=0.5), BCConfig(**SHORT)],
)
def test_the_same_seed_has_the_same_curve_and_weights(tmp_path: Path, config: Any) -> None:
    for name in ("a", "b"):
        train(corridor(), config, tmp_path / name, seed=0, progress=silent)
    assert_same_result(tmp_path / "a", tmp_path / "b")


def test_the_global_generator_is_unchanged(tmp_path: Path) -> None:
    torch.manual_seed(1)
    before = torch.get_rng_state()
    train(corridor(), SHORT_CQL, tmp_path / "run", progress=silent)
    assert torch.equal(torch.get_rng_state(), before)


def test_each_seed_gets_a_folder_and_does_not_depend_on_the_others(tmp_path: Path) -> None:
    summaries = train(corridor(), SHORT_CQL, tmp_path / "all", seeds=2, seed=3, progress=silent)
    assert [summary.folder.name for summary in summaries] == ["seed-3", "seed-4"]
    train(corridor(), SHORT_CQL, tmp_path / "one", seed=4, progress=silent)
    name = Path("seed-4", "policy.safetensors")
    weights = [load_file(tmp_path / run / name) for run in ("all", "one")]
    assert all(torch.equal(weights[0][key], weights[1][key]) for key in weights[0])


@pytest.mark.parametrize(
    ("config", "stop"),
    [*((SHORT_CQL, stop) for stop in (20, 40, 100)), *((config, 70) for config in RESUMABLE)],
)
def test_a_stopped_run_resumes_bit_for_bit(
    whole: OfflineSummary, tmp_path: Path, stop: int, config: Any
) -> None:
    expected = whole.folder.parent
    if config is not SHORT_CQL:
        expected = tmp_path / "whole"
        train(corridor(), config, expected, progress=silent)
    with pytest.raises(Stopped):
        train(corridor(), config, tmp_path / "cut", progress=StopAt(stop))
    (summary,) = train(corridor(), config, tmp_path / "cut", resume=True, progress=silent)
    assert summary.resumed_at == {20: 0, 40: 40, 70: 40, 100: 100}[stop]
    assert summary.steps == 100
    assert_same_result(tmp_path / "cut", expected)


def test_a_killed_run_resumes_bit_for_bit(whole: OfflineSummary, tmp_path: Path) -> None:
    script = """
        import sys, time
        from pathlib import Path
        from mcaprl.offline.training.train import train
        from tests.support.offline_tasks import corridor
        from tests.offline.training.test_train import SHORT_CQL

        def linger(now):
            if now.done == 70:
                print("reached", flush=True)
                time.sleep(60)

        train(corridor(), SHORT_CQL, Path(sys.argv[1]), progress=linger)
    """
    command = [sys.executable, "-c", textwrap.dedent(script), str(tmp_path / "cut")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"reached\n"
        child.kill()
    assert child.returncode == -signal.SIGKILL
    assert len(rows(tmp_path / "cut")) == 7
    (summary,) = train(corridor(), SHORT_CQL, tmp_path / "cut", resume=True, progress=silent)
    assert summary.resumed_at == 40
    assert_same_result(tmp_path / "cut", whole.folder.parent)


LONG_CQL = replace(SHORT_CQL, updates=700, checkpoint_interval=20)


def test_a_run_killed_at_random_moments_resumes_bit_for_bit(tmp_path: Path) -> None:
    script = """
        import sys
        from pathlib import Path
        from mcaprl.offline.training.train import train
        from tests.support.offline_tasks import corridor
        from tests.offline.training.test_train import LONG_CQL

        tell = lambda now: print(now.done, flush=True)
        train(corridor(), LONG_CQL, Path(sys.argv[1]), seeds=2, resume=True, progress=tell)
    """
    command = [sys.executable, "-c", textwrap.dedent(script), str(tmp_path / "cut")]
    root = ROOT
    (tmp_path / "cut").mkdir()
    for moment in np.random.default_rng().uniform(0, 0.4, 2):
        with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=root) as child:
            assert child.stdout is not None
            # On a busy machine, a new run would otherwise be killed before its first checkpoint.
            assert any(int(line) >= LONG_CQL.checkpoint_interval for line in child.stdout)
            time.sleep(moment)
            child.kill()
    resumed = train(corridor(), LONG_CQL, tmp_path / "cut", seeds=2, resume=True, progress=silent)
    assert resumed[0].resumed_at > 0
    train(corridor(), LONG_CQL, tmp_path / "whole", seeds=2, progress=silent)
    for seed in (0, 1):
        assert_same_result(tmp_path / "cut", tmp_path / "whole", seed)


def test_a_paused_run_has_a_checkpoint_and_says_where_it_resumes(
    whole: OfflineSummary, tmp_path: Path
) -> None:
    def pause(now: TrainingProgress) -> None:
        if now.done == 50:
            raise Pause

    with pytest.raises(Pause):
        train(corridor(), SHORT_CQL, tmp_path / "cut", progress=pause)
    reported: list[TrainingProgress] = []
    train(corridor(), SHORT_CQL, tmp_path / "cut", resume=True, progress=reported.append)
    assert reported[0] == TrainingProgress(0, 50, 100, {})
    assert [now.done for now in reported[1:]] == [60, 70, 80, 90, 100]
    assert_same_result(tmp_path / "cut", whole.folder.parent)


def test_incomplete_and_damaged_rows_are_dropped(whole: OfflineSummary, tmp_path: Path) -> None:
    with pytest.raises(Stopped):
        train(corridor(), SHORT_CQL, tmp_path / "cut", progress=StopAt(50))
    with (tmp_path / "cut" / "seed-0" / "metrics.csv").open("ab") as file:
        file.write(b"\xff\n9x,0\n60,0.00")
    train(corridor(), SHORT_CQL, tmp_path / "cut", resume=True, progress=silent)
    assert_same_result(tmp_path / "cut", whole.folder.parent)


def test_the_checkpoint_is_written_after_the_policy(whole: OfflineSummary) -> None:
    # If the last checkpoint were written first, a kill before the policy is written would leave an
    # old policy beside the checkpoint of a finished run.
    folder = whole.folder
    names = ("policy.safetensors", "policy.json", "checkpoint.safetensors")
    times_ns = [(folder / name).stat().st_mtime_ns for name in names]
    assert max(times_ns) == times_ns[-1]


@pytest.fixture
def stopped(tmp_path: Path) -> Path:
    """Return the folder of a run of the seeds 5 and 6 that was stopped after a checkpoint."""
    with pytest.raises(Stopped):
        train(corridor(), SHORT_CQL, tmp_path / "run", seeds=2, seed=5, progress=StopAt(50))
    return tmp_path / "run"


@pytest.mark.parametrize("given", [{}, {"seeds": 2}, {"seed": 5}])
def test_resuming_trains_all_seeds_of_the_run(stopped: Path, given: dict[str, Any]) -> None:
    (stopped / "seed-6" / "checkpoint.safetensors").unlink()
    summaries = train(corridor(), SHORT_CQL, stopped, **given, resume=True, progress=silent)
    assert [(one.seed, one.resumed_at, one.steps) for one in summaries] == [
        (5, 40, 100),
        (6, 0, 100),
    ]


@pytest.mark.parametrize("given", [{"seeds": 1}, {"seed": 0}, {"seed": 6}])
def test_resuming_keeps_the_seeds_of_the_run(stopped: Path, given: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="a run of 2 seeds, the first of which is 5: resume it"):
        train(corridor(), SHORT_CQL, stopped, **given, resume=True, progress=silent)


def test_resuming_may_add_seeds(stopped: Path) -> None:
    summaries = train(corridor(), SHORT_CQL, stopped, seeds=3, resume=True, progress=silent)
    assert [(one.seed, one.resumed_at) for one in summaries] == [(5, 40), (6, 40), (7, 0)]
    again = train(corridor(), SHORT_CQL, stopped, resume=True, progress=silent)
    assert [one.seed for one in again] == [5, 6, 7]


def test_the_seeds_of_a_run_without_them_in_its_config_are_its_folders(stopped: Path) -> None:
    config = json.loads((stopped / "config.json").read_text())
    older = {name: value for name, value in config.items() if name not in ("seeds", "seed")}
    (stopped / "config.json").write_text(json.dumps(older))
    with pytest.raises(UsageError, match="a run of 2 seeds"):
        train(corridor(), SHORT_CQL, stopped, seed=0, resume=True, progress=silent)
    summaries = train(corridor(), SHORT_CQL, stopped, resume=True, progress=silent)
    assert [one.seed for one in summaries] == [5, 6]
    assert json.loads((stopped / "config.json").read_text()) == config
    (stopped / "config.json").write_text(json.dumps(older))
    more = train(corridor(), SHORT_CQL, stopped, seeds=3, resume=True, progress=silent)
    assert [one.seed for one in more] == [5, 6, 7]


def test_a_run_resumes_only_with_its_own_data(copied: Path) -> None:
    with pytest.raises(TrainingError, match=r"config\.json was trained on other data"):
        train(corridor(repeat=21), SHORT_CQL, copied, resume=True, progress=silent)


@pytest.mark.parametrize(
    ("other", "says"),
    [
        (replace(SHORT_CQL, alpha=2.0), "has alpha 1.0, not 2.0"),
        (replace(SHORT_CQL, updates=99), "has 100 updates, more than 99; resume with at least 100"),
        (BCConfig(**SHORT), "has algo 'cql', not 'bc'"),
    ],
)
def test_a_run_resumes_only_with_its_own_settings(copied: Path, other: Any, says: str) -> None:
    with pytest.raises(TrainingError, match=says):
        train(corridor(), other, copied, resume=True, progress=silent)


@pytest.mark.parametrize("config", RESUMABLE)
def test_a_finished_run_continues_to_more_updates_bit_for_bit(config: Any, tmp_path: Path) -> None:
    config = replace(config, final_learning_rate_fraction=1.0)
    train(corridor(), config, tmp_path / "whole", seeds=2, progress=silent)
    train(corridor(), replace(config, updates=70), tmp_path / "cut", seeds=2, progress=silent)
    # A second continuation is killed after its first checkpoint, at update 80.
    with pytest.raises(Stopped):
        train(corridor(), config, tmp_path / "cut", resume=True, progress=StopAt(90))
    found = train(corridor(), config, tmp_path / "cut", resume=True, progress=silent)
    assert [(one.seed, one.resumed_at, one.steps) for one in found] == [(0, 80, 100), (1, 80, 100)]
    for seed in (0, 1):
        assert_same_result(tmp_path / "cut", tmp_path / "whole", seed)
        assert [int(row["update"]) for row in rows(tmp_path / "cut", seed)] == [*range(10, 101, 10)]
    assert json.loads((tmp_path / "cut" / "config.json").read_bytes())["config"]["updates"] == 100
    assert read_policy(tmp_path / "cut" / "seed-0").algo == found[0].algo


def test_a_run_continues_from_an_end_between_two_checkpoints(tmp_path: Path) -> None:
    config = replace(SHORT_CQL, final_learning_rate_fraction=1.0)
    (whole,) = train(corridor(), config, tmp_path / "whole", progress=silent)
    train(corridor(), replace(config, updates=33), tmp_path / "run", progress=silent)
    (found,) = train(corridor(), config, tmp_path / "run", resume=True, progress=silent)
    assert (found.resumed_at, found.steps) == (33, 100)
    for name in ("policy.safetensors", "checkpoint.safetensors"):
        mine, theirs = (load_file(one.folder / name) for one in (found, whole))
        assert all(torch.equal(mine[key], tensor) for key, tensor in theirs.items())
    assert [int(row["update"]) for row in rows(tmp_path / "run")] == [
        10, 20, 30, 33, *range(40, 101, 10)
    ]  # fmt: skip


def test_a_continued_run_with_a_decaying_learning_rate_warns(tmp_path: Path) -> None:
    config = replace(SHORT_CQL, final_learning_rate_fraction=0.1, learning_rate=1e-3)
    train(corridor(), replace(config, updates=50), tmp_path, progress=silent)
    with pytest.warns(UserWarning, match="decayed over 50 updates and continues as for 100"):
        train(corridor(), config, tmp_path, resume=True, progress=silent)
    rates = [float(row["learning_rate"]) for row in rows(tmp_path)]
    # After 49 of 50 updates, and after 59 of 100.
    assert rates[4] == pytest.approx(1e-4)
    assert rates[5] == pytest.approx(1e-3 * (1 - 0.9 * 59 / 99))


def test_a_run_resumed_with_other_versions_warns(copied: Path) -> None:
    config = json.loads((copied / "config.json").read_bytes())
    installed = {name: version(name) for name in ("torch", "numpy")}
    assert {name: config["versions"][name] for name in installed} == installed
    config["versions"] |= {"torch": "1.13.1", "numpy": "1.26.0"}
    (copied / "config.json").write_text(json.dumps(config))
    message = (
        rf"run was started with torch 1\.13\.1, not {re.escape(installed['torch'])} and numpy"
        rf" 1\.26\.0, not {re.escape(installed['numpy'])}: the resumed run may end in other bits"
    )
    for _ in range(2):
        with pytest.warns(UserWarning, match=message):
            train(corridor(), SHORT_CQL, copied, resume=True, progress=silent)


def test_a_run_without_versions_resumes(copied: Path) -> None:
    config = json.loads((copied / "config.json").read_bytes())
    del config["versions"]
    (copied / "config.json").write_text(json.dumps(config))
    train(corridor(), SHORT_CQL, copied, resume=True, progress=silent)
    assert "versions" not in json.loads((copied / "config.json").read_bytes())


@pytest.mark.parametrize("content", [b"", b"nonsense", b"\xff" * 64])
def test_a_broken_checkpoint_is_named(copied: Path, content: bytes) -> None:
    path = copied / "seed-0" / "checkpoint.safetensors"
    path.write_bytes(content)
    with pytest.raises(TrainingError, match=f"{path} is broken"):
        train(corridor(), SHORT_CQL, copied, resume=True, progress=silent)


def test_a_checkpoint_of_other_data_is_refused(copied: Path, tmp_path: Path) -> None:
    train(corridor(repeat=21), SHORT_CQL, tmp_path / "other", progress=silent)
    name = Path("seed-0", "checkpoint.safetensors")
    (copied / name).write_bytes((tmp_path / "other" / name).read_bytes())
    with pytest.raises(TrainingError, match=r"checkpoint\.safetensors was trained on other data"):
        train(corridor(), SHORT_CQL, copied, resume=True, progress=silent)


def test_an_existing_run_is_not_replaced(copied: Path) -> None:
    before = (copied / "config.json").read_bytes()
    with pytest.raises(OutputExistsError, match=f"{copied} exists"):
        train(corridor(), BCConfig(**SHORT), copied, progress=silent)
    assert (copied / "config.json").read_bytes() == before


@pytest.mark.parametrize("resume", [False, True])
def test_a_folder_without_a_run_is_not_touched(tmp_path: Path, resume: bool) -> None:
    (tmp_path / "thesis.tex").write_text("")
    message = "has no run to resume" if resume else "choose another folder"
    with pytest.raises(TrainingError if resume else OutputExistsError, match=message):
        train(corridor(), SHORT_CQL, tmp_path, resume=resume, progress=silent)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_resuming_a_missing_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="run has no run to resume: check the path"):
        train(corridor(), SHORT_CQL, tmp_path / "run", resume=True, progress=silent)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("resume", [False, True])
def test_a_run_killed_before_its_first_write_starts_again(tmp_path: Path, resume: bool) -> None:
    (tmp_path / ".config.json.part").mkdir()
    (tmp_path / ".config.json.part" / "config.json").write_text("{")
    (summary,) = train(corridor(), SHORT_CQL, tmp_path, resume=resume, progress=silent)
    assert (summary.resumed_at, summary.steps) == (0, 100)
    assert not (tmp_path / ".config.json.part").exists()


@pytest.mark.parametrize("resume", [False, True])
def test_a_second_training_in_the_folder_is_refused_before_the_first_checkpoint(
    whole: OfflineSummary, tmp_path: Path, resume: bool
) -> None:
    run = tmp_path / "run"
    refused = []

    def begin_another(now: TrainingProgress) -> None:
        before = (run / "config.json").read_bytes()
        if not (run / "seed-0" / "checkpoint.safetensors").exists():
            with pytest.raises(TrainingError, match="run is in use by another") as caught:
                train(corridor(), BCConfig(**SHORT), run, resume=resume, progress=silent)
            refused.append(caught.value)
        assert (run / "config.json").read_bytes() == before

    train(corridor(), SHORT_CQL, run, progress=begin_another)
    assert refused
    assert_same_result(run, whole.folder.parent)


def test_a_file_is_no_run_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputExistsError, match="is a file"):
        train(corridor(), SHORT_CQL, tmp_path / "file", progress=silent)


def test_a_loss_that_is_not_finite_stops_with_step_term_and_checkpoint(tmp_path: Path) -> None:
    # The first update changes the weights of each of the four layers by about 1e15. The outputs
    # then exceed the range of float32.
    wild = {"learning_rate": 1e15, "hidden": (16, 16, 16), "checkpoint_interval": 1}
    with pytest.raises(TrainingError) as caught:
        train(
            corridor(),
            DQNConfig(**{**SHORT, **wild}, gamma=0.5, target_interval=10),
            tmp_path / "run",
            progress=silent,
        )
    message = str(caught.value)
    folder = tmp_path / "run" / "seed-0"
    assert message.startswith(f"update 2 of {tmp_path / 'run'}: mean_q of seed 0 is ")
    assert f"Last good checkpoint: {folder / 'checkpoint.safetensors'}" in message
    assert "\n" not in message
    weights = load_file(folder / "policy.safetensors")
    assert all(torch.isfinite(tensor).all() for tensor in weights.values())


def test_a_loss_that_is_not_finite_at_once_has_no_checkpoint(tmp_path: Path) -> None:
    huge = Dataset.from_arrays(
        observations=np.zeros((4, 1), np.float32),
        actions=np.zeros(4, np.int64),
        rewards=np.full(4, 3e38),
        terminated=np.ones(4, bool),
        truncated=np.zeros(4, bool),
        next_observations=np.zeros((4, 1), np.float32),
    )
    with pytest.raises(TrainingError, match=r"update 1 of .*checkpoint: none yet"):
        train(huge, DQNConfig(**SHORT, gamma=0.5), tmp_path / "run", progress=silent)


def test_a_refused_request_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="unknown algorithm 'ddqn'"):
        train(corridor(), "ddqn", tmp_path / "run")
    with pytest.raises(UsageError, match="seeds must be at least 1"):
        train(corridor(), SHORT_CQL, tmp_path / "run", seeds=0)
    continuous = Dataset.from_arrays(
        observations=np.zeros((4, 1), np.float32),
        actions=np.zeros((4, 1), np.float32),
        rewards=np.zeros(4),
        terminated=np.ones(4, bool),
        truncated=np.zeros(4, bool),
        next_observations=np.zeros((4, 1), np.float32),
    )
    with pytest.raises(SpaceError, match="discrete"):
        train(continuous, SHORT_CQL, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_nothing_is_printed_without_a_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train(corridor(), SHORT_CQL, tmp_path / "run")
    printed = capsys.readouterr()
    assert printed.out == printed.err == ""


def test_importing_the_package_loads_no_torch() -> None:
    script = "import sys, mcaprl.offline; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", script], check=True)


def test_seeds_stopped_at_different_updates_resume_bit_for_bit(tmp_path: Path) -> None:
    # Simulate a kill between the checkpoints of the two seeds at update 80.
    train(corridor(), SHORT_CQL, tmp_path / "whole", seeds=2, progress=silent)
    with pytest.raises(Stopped):
        train(corridor(), SHORT_CQL, tmp_path / "cut", seeds=2, progress=StopAt(90))
    with pytest.raises(Stopped):
        train(corridor(), SHORT_CQL, tmp_path / "early", seeds=2, progress=StopAt(50))
    name = Path("seed-1", "checkpoint.safetensors")
    (tmp_path / "cut" / name).write_bytes((tmp_path / "early" / name).read_bytes())
    summaries = train(
        corridor(), SHORT_CQL, tmp_path / "cut", seeds=2, resume=True, progress=silent
    )
    assert [summary.resumed_at for summary in summaries] == [80, 40]
    for seed in (0, 1):
        assert_same_result(tmp_path / "cut", tmp_path / "whole", seed)


def test_other_data_are_accepted_on_request(tmp_path: Path) -> None:
    config = replace(SHORT_CQL, normalize=True)
    with pytest.raises(Stopped):
        train(corridor(), config, tmp_path / "run", progress=StopAt(50))
    before = read_policy(tmp_path / "run" / "seed-0").encoder
    other = corridor({(1, 0): 3, (2, 1): 1, (3, 1): 2})
    with pytest.raises(TrainingError, match=r"other data;.*`other_data=True`"):
        train(other, config, tmp_path / "run", resume=True, progress=silent)
    (summary,) = train(
        other, config, tmp_path / "run", resume=True, other_data=True, progress=silent
    )
    assert summary.resumed_at == 40
    assert json.loads((tmp_path / "run" / "config.json").read_text())["data"] == other.fingerprint
    # The weights were trained with the old normalization.
    after = read_policy(tmp_path / "run" / "seed-0").encoder
    assert np.array_equal(before.shift, after.shift)
    train(other, config, tmp_path / "run", resume=True, progress=silent)


def test_weights_are_part_of_the_data(tmp_path: Path) -> None:
    data = crossing()
    weights = np.array([1.0, 2.0, 1.0])
    weighted = data.with_weights(weights)
    train(weighted, SHORT_CQL, tmp_path / "run", progress=silent)
    train(weighted, SHORT_CQL, tmp_path / "run", resume=True, progress=silent)
    with pytest.raises(TrainingError, match="other data"):
        train(data, SHORT_CQL, tmp_path / "run", resume=True, progress=silent)
    with pytest.raises(UsageError, match="3 numbers of at least 0"):
        data.with_weights(-weights)


@pytest.mark.parametrize("leave", [True, False])
def test_a_failed_start_does_not_block_the_next(tmp_path: Path, leave: bool) -> None:
    with pytest.raises(Stopped):
        train(corridor(), SHORT_CQL, tmp_path / "run", seeds=2, progress=StopAt(20))
    if not leave:
        (tmp_path / "run" / "seed-0" / "mine.txt").write_text("")
        with pytest.raises(OutputExistsError):
            train(corridor(), BCConfig(**SHORT), tmp_path / "run", progress=silent)
        return
    train(corridor(), BCConfig(**SHORT), tmp_path / "run", progress=silent)
    assert json.loads((tmp_path / "run" / "config.json").read_text())["algo"] == "bc"
    assert len(rows(tmp_path / "run")) == 10
    events = EventAccumulator(str(tmp_path / "run" / "seed-0"))
    events.Reload()
    assert "train/td_loss" not in events.Tags()["scalars"]


def test_seeds_are_described_with_mean_and_interval(tmp_path: Path) -> None:
    summaries = train(corridor(), BCConfig(**SHORT), tmp_path / "run", seeds=3, progress=silent)
    *lines, mean = describe_seeds(summaries)
    assert [str(summary.folder) in line for summary, line in zip(summaries, lines, strict=True)]
    losses = [summary.terms["loss"] for summary in summaries]
    assert f"loss {np.mean(losses):.4g} [" in mean


def test_a_resumed_seed_is_described_with_all_its_updates(stopped: Path) -> None:
    (stopped / "seed-6" / "checkpoint.safetensors").unlink()
    summaries = train(corridor(), SHORT_CQL, stopped, resume=True, progress=silent)
    resumed, restarted, _ = describe_seeds(summaries)
    assert f"{stopped / 'seed-5'}: 100 updates (60 in this session), " in resumed
    assert f"{stopped / 'seed-6'}: 100 updates, " in restarted


def test_curves_are_plotted_from_all_seeds(tmp_path: Path) -> None:
    train(corridor(), SHORT_CQL, tmp_path / "run", seeds=2, progress=silent)
    path = draw_curves(tmp_path / "run")
    assert path.read_bytes().startswith(b"\x89PNG")
    curve = read_curve(tmp_path / "run" / "seed-1" / "metrics.csv")
    assert curve["update"].tolist() == list(range(10, 101, 10))
