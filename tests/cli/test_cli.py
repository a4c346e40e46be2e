"""Tests of the commands: printed text, written files, and exit codes."""

from __future__ import annotations

import importlib.util
import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import OutputExistsError, SpaceError
from mcaprl.recorder.columns.reader import McapReader
from tests.support.paths import GOLDEN

LANE_LOG = GOLDEN / "lane-1.mcap"

needs_online = pytest.mark.skipif(
    importlib.util.find_spec("stable_baselines3") is None, reason="needs the extra online"
)


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def fails(capsys: pytest.CaptureFixture[str], code: int, *arguments: str) -> str:
    """Run a command that fails with one line on stderr, and return the line."""
    assert run(arguments) == code
    out, err = capsys.readouterr()
    assert err.count("\n") == 1, f"not one line: {err!r}"
    assert err.startswith("mcaprl: ")
    assert "Traceback" not in out + err
    return err


def as_json(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> Any:
    assert run(arguments) == code
    return json.loads(capsys.readouterr().out)


@pytest.fixture
def cartpole() -> Path:
    path = Path("cartpole.mcap")
    assert (
        run(["record", "CartPole-v1", "--policy", "random", "--episodes", "4", "--out", str(path)])
        == 0
    )
    return path


def test_record_info_check(cartpole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    facts = as_json(capsys, "info", str(cartpole), "--json")
    data = mcaprl.open(cartpole)
    assert facts["env_id"] == "CartPole-v1"
    assert (facts["episodes"], facts["steps"]) == (4, len(data))
    assert facts["mean_return"] == data.statistics.mean_return
    assert facts["size_bytes"] == cartpole.stat().st_size
    assert facts["duration_s"] == pytest.approx(len(data) * 0.02)
    assert facts["ends"] == {"terminated": 4}
    assert facts["problems"] == []
    assert {"observations", "actions"} <= set(facts)
    assert as_json(capsys, "check", str(cartpole), "--json") == {"ok": True, "problems": []}
    assert run(["info", str(cartpole)]) == 0
    assert "CartPole-v1" in capsys.readouterr().out
    assert (data.behavior_probs == 0.5).all()


def test_info_report_and_strict(cartpole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(cartpole), "--report", "report", "--strict"]) == 0
    assert Path("report/dataset.png").read_bytes()[:4] == b"\x89PNG"
    assert json.loads(Path("report/dataset.json").read_text())["episodes"] == 4
    cut = cartpole.read_bytes()
    Path("cut.mcap").write_bytes(cut[: -len(cut) // 3])
    capsys.readouterr()
    facts = as_json(capsys, "info", "cut.mcap", "--strict", "--json", code=1)
    assert "was cut off" in facts["problems"][0]


def test_a_single_policy_is_not_compared(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["evaluate", "random", "--sim", "CartPole-v1", "--episodes", "2"]) == 0
    printed = capsys.readouterr().out
    assert "2 episodes for each policy" in printed
    assert "probability" not in printed


def test_evaluate_from_the_log_alone(cartpole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    few = ["--updates", "30", "--batch-size", "16", "--hidden", "8", "--seeds", "2"]
    assert run(["train-offline", str(cartpole), "--algo", "bc", "--out", "bc", *few]) == 0
    capsys.readouterr()
    ask = ["evaluate", "random", "bc", "--data", str(cartpole), "--updates", "5"]
    result = as_json(capsys, *ask, "--json")
    assert result["episodes"] == 4
    assert {estimate["policy"] for estimate in result["estimates"]} == {
        "random",
        "bc/seed-0",
        "bc/seed-1",
    }
    for estimate in result["estimates"]:
        assert estimate.keys() == {
            "policy",
            "estimator",
            "value",
            "interval",
            "effective_sample_size",
            "verdict",
            "spread",
            "usable_steps",
        }
        # Four episodes are too few for a verdict.
        assert estimate["verdict"].startswith("refused: ")
    random = {e["estimator"]: e for e in result["estimates"] if e["policy"] == "random"}
    assert random["PDIS"]["value"] == pytest.approx(result["behavior_return"]), "random acted"
    assert result["behavior_calibration"]["text"] == "2.00 +- 0.00 actions; the action space has 2"
    assert result["coverage"]["random"] == pytest.approx(0.5)
    assert result["ranking"]["trusted"] is False
    assert set(result["answers"]) == {"random", "bc/seed-0", "bc/seed-1"}
    assert run(ask) == 0
    short = capsys.readouterr().out
    assert "bc/seed-0: unknown, beside the log's" in short
    assert "best first" not in short, "no estimator is trusted for all policies"
    assert "verdict" not in short
    assert run([*ask, "--all"]) == 0
    assert "effective episodes, 10 needed" in capsys.readouterr().out
    line = fails_after(capsys, 2, "evaluate", "pilot", "--data", str(cartpole))
    assert "pilot has no network to evaluate on a log" in line


def test_counts_of_one_are_singular(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["record", "CartPole-v1", "--policy=random", "--steps=1", "--out=one.mcap"]) == 0
    assert "one.mcap: 1 episode, 1 step, mean return 1.00" in capsys.readouterr().out
    assert run(["recover", "one.mcap", "two.mcap"]) == 0
    assert "two.mcap: 1 episode, 7 messages" in capsys.readouterr().out


def test_recordings_with_noise_repeat_and_have_densities(
    capsys: pytest.CaptureFixture[str],
) -> None:
    options = ["--actions", "continuous", "--noise", "0.1", "--noise-per-episode", "--steps", "50"]
    for name in ("a", "b"):
        assert run(["record", "racer", *options, "--out", f"{name}.mcap"]) == 0
    first, second = mcaprl.open("a.mcap"), mcaprl.open("b.mcap")
    assert first.fingerprint == second.fingerprint
    assert first.action_part_names == ("acceleration", "turn")
    assert np.isfinite(first.behavior_log_probs).all()
    assert run(["record", "racer", "--actions", "5", "--steps", "9", "--out", "c.mcap"]) == 0
    assert mcaprl.open("c.mcap").env_kwargs == {"actions": 5}
    assert run(["record", "racer", "--noise", "0.1", "--steps", "9", "--out", "d.mcap"]) == 2
    assert "--noise needs a Box of floats, not Discrete(9)" in capsys.readouterr().err


def test_recordings_repeat(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        arguments = ["--policy", "pilot", "--epsilon", "0.3", "--steps", "50", "--seed", "3"]
        assert run(["record", "lane", *arguments, "--out", f"{name}.mcap"]) == 0
    first, second = mcaprl.open("a.mcap"), mcaprl.open("b.mcap")
    assert len(first) == 50
    assert first.fingerprint == second.fingerprint
    assert first.episodes[0].policy == "pilot"
    assert first.episodes[0].epsilon == 0.3
    own, other = 0.3 / 6 + 0.7, 0.3 / 6
    assert set(first.behavior_probs) == {np.float32(own), np.float32(other)}


def test_appended_and_rotated_recordings_are_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    common = ["record", "CartPole-v1", "--policy", "random", "--seed", "2"]
    assert run([*common, "--episodes", "5", "--out", "one.mcap"]) == 0
    expected = mcaprl.open("one.mcap").fingerprint
    for episodes in ("3", "2"):
        assert run([*common, "--episodes", episodes, "--out", "two.mcap", "--append"]) == 0
    assert mcaprl.open("two.mcap").fingerprint == expected
    for episodes in ("3", "2"):
        arguments = ["--episodes", episodes, "--out", "parts/a.mcap", "--rotate-mb", "0.005"]
        assert run([*common, *arguments, "--append"]) == 0
    assert len(list(Path("parts").iterdir())) > 1
    assert mcaprl.open("parts").fingerprint == expected
    capsys.readouterr()
    assert run([*common, "--episodes", "2", "--out", "x", "--append", "--envs", "2"]) == 2
    assert "omit one of them" in capsys.readouterr().err


def test_shards_contain_the_same_episodes(capsys: pytest.CaptureFixture[str]) -> None:
    common = ["record", "CartPole-v1", "--policy", "random", "--episodes", "5", "--seed", "2"]
    assert run([*common, "--out", "one.mcap"]) == 0
    assert run([*common, "--out", "shards", "--envs", "2"]) == 0
    assert sorted(path.name for path in Path("shards").iterdir()) == [
        "shard-00.mcap",
        "shard-01.mcap",
    ]
    assert mcaprl.open("shards").fingerprint == mcaprl.open("one.mcap").fingerprint
    assert "exists" in fails_after(capsys, 2, *common, "--out", "shards", "--envs", "2")
    assert run([*common, "--out", "shards", "--envs", "3", "--overwrite"]) == 0
    assert len(mcaprl.open("shards").episodes) == 5


def test_invalid_arguments_leave_existing_shards(capsys: pytest.CaptureFixture[str]) -> None:
    common = ["--policy", "random", "--episodes", "2", "--envs", "2", "--overwrite", "--out", "d"]
    Path("d").mkdir()
    Path("d/shard-00.mcap").write_text("old")
    assert "CartPole-v1" in fails_after(capsys, 2, "record", "CartPol-v1", *common)
    common[1] = "nobody"
    assert "unknown policy" in fails_after(capsys, 2, "record", "CartPole-v1", *common)
    assert Path("d/shard-00.mcap").read_text() == "old"
    Path("d/precious.mcap").write_text("mine")
    common[1] = "random"
    assert "precious.mcap" in fails_after(capsys, 2, "record", "CartPole-v1", *common)


def test_names_are_not_interpreted_as_markup(
    cartpole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cartpole.rename("run[red].mcap")
    capsys.readouterr()
    assert run(["info", "run[red].mcap"]) == 0
    assert "run[red].mcap" in capsys.readouterr().out


def fails_after(capsys: pytest.CaptureFixture[str], code: int, *arguments: str) -> str:
    capsys.readouterr()
    return fails(capsys, code, *arguments)


def test_learn_evaluate_replay(capsys: pytest.CaptureFixture[str]) -> None:
    """The main workflow at a small size: record, train, evaluate, record the trained policy."""
    common = ["record", "lane", "--no-scene", "--out"]
    assert run([*common, "data/a.mcap", "--epsilon", "0.1", "--steps", "400"]) == 0
    assert run([*common, "data/b.mcap", "--policy", "random", "--steps", "100"]) == 0
    small = ["--updates", "60", "--batch-size", "32", "--hidden", "16,16", "--alpha", "0.5"]
    # With fewer target syncs, training would warn about the horizon of gamma.
    small += ["--gamma", "0.5", "--target-interval", "6", "--dueling"]
    assert run(["train-offline", "data", "--out", "run", "--seeds", "2", *small]) == 0
    assert json.loads(Path("run/config.json").read_text())["env_id"] == "mcaprl/LaneKeeping-v0"
    capsys.readouterr()
    result = as_json(
        capsys, "evaluate", "run", "--sim", "lane", "--episodes", "3", "--behavior", "data",
        "--report", "report", "--record", "episodes.mcap", "--json",
    )  # fmt: skip
    assert result["sim"] == "lane"
    scores = {score["policy"]: score for score in result["policies"]}
    assert list(scores) == ["run", "pilot", "random"], "what was asked for comes first"
    assert scores["run"]["episodes"] == 6
    assert len(scores["run"]["returns"]) == 6
    assert len(scores["run"]["seed_means"]) == 2
    low, high = scores["run"]["interval"]
    assert low <= scores["run"]["mean_return"] <= high
    assert scores["pilot"]["normalized_score"] == 1.0
    assert scores["random"]["normalized_score"] == 0.0
    assert result["behavior"]["episodes"] == len(mcaprl.open("data").episodes)
    for name in ("comparison.png", "trajectories.png", "evaluation.json"):
        assert (Path("report") / name).stat().st_size > 500
    before = Path("report/evaluation.json").read_bytes()
    with pytest.raises(OutputExistsError):
        mcaprl.evaluate("run", "lane", episodes=3, report="report", record="episodes.mcap")
    assert Path("report/evaluation.json").read_bytes() == before
    recorded = mcaprl.open("episodes.mcap")
    assert [episode.total_reward for episode in recorded.episodes] == scores["run"]["returns"]
    assert {episode.policy for episode in recorded.episodes} == {"run/seed-0", "run/seed-1"}
    replay = [
        "record",
        "lane",
        "--policy",
        "run/seed-1",
        "--steps",
        "5",
        "--camera",
        "--out",
        "r.mcap",
    ]
    assert run(replay) == 0
    assert mcaprl.open("r.mcap").episodes[0].policy == "seed-1"
    policy = mcaprl.load_policy("run")
    assert policy.act(recorded.observations[:7]).shape == (7,)


def test_resume_continues_training(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["record", "lane", "--steps", "200", "--no-scene", "--out", "d.mcap"]) == 0
    train = [
        "train-offline",
        "d.mcap",
        "--algo",
        "bc",
        "--out",
        "run",
        "--updates",
        "20",
        "--hidden",
        "8",
    ]
    assert run(train) == 0
    assert "resume" in fails_after(capsys, 2, *train)
    capsys.readouterr()
    assert run(["train-offline", "d.mcap", "--out", "run", "--resume"]) == 0, (
        "settings are the run's"
    )
    assert "0 updates" in capsys.readouterr().out
    fewer = ["--resume", "--updates", "10"]
    assert "20" in fails_after(capsys, 1, *train, *fewer)
    Path("run/config.json").write_text("[]")
    assert "not a JSON object" in fails_after(capsys, 1, *train, "--resume")


def test_check_continues_after_a_missing_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", "missing.mcap", str(LANE_LOG)]) == 1
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    result = as_json(capsys, "check", "missing.mcap", str(LANE_LOG), "--json", code=1)
    assert [problem["file"] for problem in result["problems"]] == ["missing.mcap"]


def test_logs_are_not_overwritten_by_other_outputs(
    cartpole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = cartpole.read_bytes()
    for source in ("lane", str(cartpole)):
        line = fails_after(capsys, 2, "layout", source, "--out", str(cartpole), "--overwrite")
        assert "a layout is a JSON file" in line
    evaluate = ["evaluate", "random", "--sim", "CartPole-v1", "--episodes", "1", "--overwrite"]
    both = ["--behavior", str(cartpole), "--record", str(cartpole)]
    assert "record the episodes elsewhere" in fails_after(capsys, 2, *evaluate, *both)
    assert cartpole.read_bytes() == before
    line = fails_after(capsys, 2, "evaluate", "pilot", "--sim", "lane", "--behavior", str(cartpole))
    assert "was recorded in CartPole-v1, not in mcaprl/LaneKeeping-v0" in line


def test_policies_with_equal_names_are_shown_with_paths(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        run(["record", "CartPole-v1", "--policy", "random", "--steps", "60", "--out", "d.mcap"])
        == 0
    )
    for folder in ("a/bc", "b/bc"):
        small = ["--algo", "bc", "--updates", "3", "--hidden", "4", "--out", folder]
        assert run(["train-offline", "d.mcap", *small]) == 0
    capsys.readouterr()
    evaluate = ["evaluate", "a/bc", "b/bc", "a/bc", "--sim", "CartPole-v1", "--episodes", "1"]
    result = as_json(capsys, *evaluate, "--json")
    assert [score["policy"] for score in result["policies"]] == ["a/bc", "b/bc", "random"]
    assert result["policies"][0]["normalized_score"] is None, "CartPole has no pilot"


def test_layout_of_file_and_sim(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["layout", str(LANE_LOG), "--out", "a.json"]) == 0
    attached = McapReader(LANE_LOG).attachment("foxglove-layout.json")
    assert attached is not None
    assert json.loads(Path("a.json").read_text()) == json.loads(attached)
    assert run(["layout", "lane", "--out", "b.json"]) == 0
    assert "3D!scene" in json.loads(Path("b.json").read_text())["configById"]
    assert run(["layout", "CartPole-v1", "--out", "c.json"]) == 0
    capsys.readouterr()
    assert run(["layout", "lane", "--out", "-"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(Path("b.json").read_text())
    assert not Path("-").exists()
    assert "exists" in fails_after(capsys, 2, "layout", "lane", "--out", "c.json")


@pytest.mark.parametrize(
    ("arguments", "code", "reported"),
    [
        (["record", "lan", "--steps", "5", "--out=x.mcap"], 2, "did you mean lane?"),
        (["record", "CartPol-v1", "--steps", "5", "--out=x.mcap"], 2, "CartPole-v1"),
        (["record", "a:b:c", "--steps", "5", "--out=x.mcap"], 2, "a:b:c"),
        (["record", "lane", "--policy", "pilt", "--steps", "5", "--out=x.mcap"], 2, "mean pilot?"),
        (["record", "CartPole-v1", "--steps", "5", "--out=x.mcap"], 2, "CartPole-v1"),
        (["record", "lane", "--out=x.mcap"], 2, "--episodes N or --steps N"),
        (["record", "lane", "--steps", "5"], 2, "Missing option '--out'"),
        (["record", "lane", "--steps", "-1", "--out=x.mcap"], 2, "--steps"),
        (["record", "lane", "--steps", "5", "--out=x.mcap", "--epsilon", "2"], 2, "--epsilon"),
        (["record", "lane", "--steps", "5", "--out=x.mcap", "--rules", "odd"], 2, "classic-code"),
        (["record", "lane", "--steps=5", "--out=x.mcap", "--observation", "sound"], 2, "depth, "),
        (["record", "lane", "--steps", "5", "--out", "taken/x.mcap"], 1, "cannot write taken/"),
        (["record", "lane", "--steps", "5", "--out", "empty.mcap"], 2, "empty.mcap exists"),
        (["record", "lane", "--steps", "5", "--out", "x.csv"], 2, "x.csv: the name of a log must"),
        (["record", "lane", "--steps", "5", "--out", "-"], 2, "a log must end in .mcap"),
        (["recover", str(LANE_LOG), "x"], 2, "a log must end in .mcap"),
        (["annotate", str(LANE_LOG), "--scene", "--out", "x"], 2, "a log must end in .mcap"),
        (["slice", str(LANE_LOG), "x", "--steps", "0:9"], 2, "a log must end in .mcap"),
        (["evaluate", "pilot", "--sim", "lane", "--record", "x"], 2, "a log must end in .mcap"),
        (
            ["record", "lane", "--policy", str(LANE_LOG), "--steps", "5", "--out=x.mcap"],
            1,
            "lane-1.mcap is a log: pass the path of a trained run",
        ),
        (
            ["record", "FrozenLake-v1", "--observation", "depth", "--steps", "5", "--out=x.mcap"],
            2,
            "sim 'FrozenLake-v1' has no argument observation: omit it",
        ),
        (["info", "nothing.mcap"], 1, "no such file"),
        (["info", "taken"], 1, "not an MCAP file"),
        (["info", "empty.mcap"], 1, "it is empty"),
        (["check", "nothing.mcap"], 1, "no such file"),
        (["train-offline", "taken", "--out", "run"], 1, "not an MCAP file"),
        (["train-offline", str(LANE_LOG), "--out", "taken"], 2, "taken exists"),
        (["train-offline", str(LANE_LOG), "--out", "taken/r"], 1, "cannot write taken/r"),
        (["evaluate", "pilot", "--sim", "lane", "--episodes=1", "--report", "taken"], 1, "cann"),
        (["info", str(LANE_LOG), "--report", "taken"], 1, "dataset.json: taken is not a folder"),
        (["train-offline", str(LANE_LOG), "--out", "r", "--algo", "cqk"], 2, "did you mean cql"),
        (["train-offline", str(LANE_LOG), "--out", "r", "--algo", "cqk"], 2, "known: auto, bc,"),
        (
            ["train-offline", str(LANE_LOG), "--out", "r", "--algo", "bc", "--alpha", "1"],
            2,
            "has --",
        ),
        (["train-offline", str(LANE_LOG), "--out", "r", "--hidden", "a,b"], 2, "256,256"),
        (["evaluate", "pilot", "--sim", "line"], 2, "did you mean lane"),
        (["evaluate", "pilot", "--sim", "CartPole-v1"], 2, "CartPole-v1 has no pilot: use random,"),
        pytest.param(["evaluate", "taken", "--sim", "lane"], 1, "taken", marks=needs_online),
        (["evaluate", "nowhere", "--sim", "lane"], 2, "unknown policy 'nowhere'"),
        (["evaluate", "runs/no", "--sim", "lane"], 2, "runs/no: no such file or folder"),
        (["evaluate", "pilot"], 2, "either --sim SIM or --data DATA"),
        (["evaluate", "pilot", "--sim", "lane", "--data", "taken"], 2, "either --sim SIM"),
        (["evaluate", "pilot", "--sim", "lane", "--gamma", ".9"], 2, "--gamma requires --data"),
        (["evaluate", "pilot", "--data", "lane.mcap", "--record", "x"], 2, "--record requires"),
        (["evaluate", "random", "--data", "l.mcap", "--episodes", "3"], 2, "--episodes requires"),
        (["evaluate", "random", "--data", "nothing"], 1, "no such file"),
        (["layout", "lane"], 2, "--out"),
        (["record", "lane", "--steps", "5", "--out=x.mcap", "--epsilon", "nan"], 2, "0 to 1"),
        (["record", "lane", "--steps", "5", "--out=x.mcap", "--envs", "2"], 2, "into a folder"),
        (["layout", "nothing.mcap", "--out", "x.json"], 1, "cannot read nothing.mcap"),
        (["info", "x" * 300], 1, "name too long"),
        (["evaluate", "pilot", "--sim", "lane", "--behavior", "nothing"], 1, "no such file"),
        (["recrod"], 2, "No such command 'recrod': did you mean record or recover?"),
        (["train"], 2, "did you mean train-online or train-offline?"),
        (["xyz"], 2, "No such command 'xyz'"),
        (["info", "--jsn", str(LANE_LOG)], 2, "--json"),
        (["record", "lane", "--json"], 2, "No such option '--json'. (see mcaprl record"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line(
    capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, reported: str
) -> None:
    Path("taken").write_text("not a log")
    Path("empty.mcap").touch()
    assert reported in fails(capsys, code, *arguments)
    assert Path("taken").read_text() == "not a log"


def test_spaces_that_differ(cartpole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = [str(cartpole), str(LANE_LOG)]
    assert "differ in" in fails_after(capsys, 1, "info", *both)
    assert "differ in" in fails_after(capsys, 1, "train-offline", *both, "--out", "r")
    small = ["--updates", "5", "--hidden", "8", "--algo", "bc"]
    assert run(["train-offline", str(cartpole), "--out", "run", *small]) == 0
    line = fails_after(capsys, 1, "evaluate", "run", "--sim", "lane")
    assert "was trained on observation_space" in line
    assert not Path("r").exists()


@needs_online
def test_training_refuses_continuous_actions_before_it_prints_anything(
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = str(GOLDEN / "multi-binary.mcap")
    for command in (
        ["train-offline", log, "--algo", "cql", "--out", "run"],
        ["train-online", "Pendulum-v1", "--algo", "dqn", "--out", "run"],
        ["train-online", "Pendulum-v1", "--algo", "double-dqn", "--out", "run", "--live"],
    ):
        assert run(command) == 1
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1), f"{command}: {out!r}, {err!r}"
        assert "needs discrete actions" in err
        assert "Box(" in err
    with pytest.raises(
        SpaceError, match=r"dqn needs discrete actions; for Box.* use iql or rebrac"
    ):
        mcaprl.train(log, "run", algo="dqn", progress=lambda now: pytest.fail("training began"))
    with pytest.raises(SpaceError, match="dqn needs discrete actions"):
        mcaprl.train_online(
            "Pendulum-v1",
            "run",
            algo="dqn",
            live=True,
            port=0,
            on_live=lambda _: pytest.fail("it listens"),
        )
    assert not Path("run").exists()


def test_a_rotated_recording_reports_its_files(capsys: pytest.CaptureFixture[str]) -> None:
    Path("r-notes.mcap").touch()
    record = ["record", "CartPole-v1", "--policy", "random", "--out", "r.mcap"]
    assert run([*record, "--episodes", "9", "--rotate-mb", "0.0001"]) == 0
    assert capsys.readouterr().out.startswith("r-00000.mcap to r-00008.mcap: 9 episodes")
    found = mcaprl.record(
        "CartPole-v1", "one.mcap", policy="random", episodes=1, rotate_mb=1000, scene=False
    )
    assert found.files == (Path("one-00000.mcap"),)
    assert found.size_bytes == found.files[0].stat().st_size
    # A file of the same name without a number belongs to another recording.
    Path("two.mcap").touch()
    found = mcaprl.record(
        "CartPole-v1", "two.mcap", policy="random", episodes=1, rotate_mb=1000, scene=False
    )
    assert found.files == (Path("two-00000.mcap"),)


def test_missing_extra(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    real_find = importlib.import_module

    def without(name: str, *rest: Any) -> Any:
        if name.split(".")[0] in ("matplotlib", "numba"):
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)
        return real_find(name, *rest)

    monkeypatch.setattr("mcaprl.errors.importlib.import_module", without)
    line = fails(capsys, 2, "record", "lane", "--steps", "5", "--out", "x.mcap")
    assert "numba is not installed: pip install 'mcaprl[sims]'" in line


def test_check_reports_what_where_and_next(capsys: pytest.CaptureFixture[str]) -> None:
    broken = bytearray(LANE_LOG.read_bytes())
    broken[len(broken) // 2] ^= 1
    Path("broken.mcap").write_bytes(broken)
    result = as_json(capsys, "check", "broken.mcap", str(LANE_LOG), "--json", code=1)
    assert result["ok"] is False
    assert all(set(problem) == {"file", "what", "where", "next"} for problem in result["problems"])
    assert {problem["file"] for problem in result["problems"]} == {"broken.mcap"}
    assert run(["check", "broken.mcap"]) == 1
    assert "broken.mcap" in capsys.readouterr().out


def test_golden_log_is_read_by_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    data = mcaprl.open(LANE_LOG)
    assert (len(data), len(data.episodes)) == (60, 2)
    assert data.fingerprint == (LANE_LOG.with_suffix(".sha256").read_text().strip())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_recording_is_readable(number: signal.Signals) -> None:
    command = [sys.executable, "-m", "mcaprl.cli", "record", "lane", "--episodes", "100000"]
    process = subprocess.Popen(
        [*command, "--out", "stopped.mcap"],
        stderr=subprocess.PIPE,
        text=True,
        # If the test runs in the background, its children would ignore SIGINT.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 120
    path = Path("stopped.mcap")
    while not (path.exists() and path.stat().st_size > 200_000):
        assert time.monotonic() < deadline
        assert process.poll() is None
        time.sleep(0.05)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err.splitlines()[-1] == "mcaprl: interrupted; finished episodes are kept"
    assert run(["check", "stopped.mcap"]) == 0
    assert len(mcaprl.open(path).episodes) >= 1


@pytest.mark.parametrize(
    ("arguments", "function", "kept"),
    [
        (["record", "lane", "--steps", "5", "--out", "x.mcap"], "record", "; finished episodes ar"),
        (["evaluate", "pilot", "--sim", "lane"], "evaluate", "\n"),
        (["evaluate", "random", "--data", str(LANE_LOG)], "estimate", "\n"),
        (["train-offline", str(LANE_LOG), "--out", "new"], "train", "\n"),
        (["train-offline", str(LANE_LOG), "--out", "run"], "train", "; continue with --resume\n"),
        (
            ["train-offline", str(LANE_LOG), "--out", "begun"],
            "train",
            "; there was no checkpoint yet; --resume begins again\n",
        ),
        pytest.param(
            ["train-online", "lane", "--out", "run"],
            "train_online",
            "; continue with --resume\n",
            marks=needs_online,
        ),
    ],
)
def test_an_interruption_says_what_is_kept(
    arguments: list[str],
    function: str,
    kept: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    for folder in ("run", "begun"):
        Path(folder).mkdir()
        Path(folder, "config.json").touch()
    Path("run/seed-0").mkdir()
    Path("run/seed-0/checkpoint.safetensors").touch()
    monkeypatch.setattr(mcaprl, function, stopped)
    assert run(arguments) == 130
    assert f"mcaprl: interrupted{kept}" in capsys.readouterr().err


def test_an_unexpected_end_of_a_file_is_no_interruption(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise EOFError("marshal data too short")

    monkeypatch.setattr(mcaprl, "check", broken)
    with pytest.raises(EOFError, match="marshal data too short"):
        run(["check", str(LANE_LOG)])


@needs_online
def test_help_has_the_defaults_of_each_sim(capsys: pytest.CaptureFixture[str]) -> None:
    from mcaprl.online.task import Task

    assert run(["train-online", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for name in ("lane", "racer", "powerline"):
        steps = Task.for_sim(name).config.steps
        shown = text.partition("over all environments [default: ")[2].partition("]")[0]
        groups = [one.split(": ") for one in shown.split("; ")[1:]]
        sims = [
            each for names, value in groups for each in names.split(", ") if value == f"{steps}"
        ]
        assert name in sims or shown.startswith(f"{steps};")
    shown = text.partition("discount per step [default: ")[2].partition("]")[0]
    assert shown.startswith("0.99; lane, highway-lane, lane (continuous),")
    assert shown.endswith(
        "racer, racer (continuous): 0.98; powerline, powerline (continuous): 0.95"
    )
