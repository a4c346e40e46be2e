"""Action errors in the states of a log, of every kind of policy, with numbers worked by hand."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import McaprlError, PolicyError, UsageError
from mcaprl.recorder.format.reading import McapReader, Topic
from tests.support.bags import START_NS, STEP_NS, write_rosbag2

X, Y = [0, 1, 2, 4, 4], [0, 2, 0, 2, 2]
ENDS = np.array([0, 0, 1, 0, 1], bool)
CODE = """
import numpy as np
def ones(observation):
    return np.ones(2, np.float32)
def chunk(observation):
    return np.array([[1, 1], [0, 0]], np.float32)
def fails(observation):
    raise RuntimeError("no battery")
def wrong(observation):
    return np.ones(3)
def turn(observation):
    return np.array([0.5, observation[0]], np.float32)
def push(observation):
    return int(observation[2] > 0)
"""
MAPPING = """
clock: {topic: /joints}
observation:
  speed: {field: /odom.twist.twist.linear.x}
action: {fields: [/cmd_vel.linear.x, /cmd_vel.angular.z], box: {low: -2, high: 2}}
episodes: {max_steps: 4}
"""


def two_drives() -> mcaprl.Dataset:
    """Return episodes of three and two steps, at the places 0, 1, 2 and 10, 11."""
    places = np.array([[0], [1], [2], [10], [11]], np.float32)
    return mcaprl.Dataset.from_arrays(
        observations=places,
        actions=np.stack([X, Y], 1).astype(np.float32),
        rewards=np.ones(5),
        terminated=ENDS,
        truncated=np.zeros(5, bool),
        next_observations=places + 1,
        action_space=spaces.Box(-5, 5, (2,), np.float32),
    )


@pytest.fixture
def code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    (tmp_path / "pilots.py").write_text(CODE)
    monkeypatch.syspath_prepend(tmp_path)
    yield "pilots"
    sys.modules.pop("pilots", None)


def test_the_errors_by_hand(code: str) -> None:
    found = mcaprl.action_errors(f"{code}:ones", two_drives(), trust_code=True)
    (one,) = found.policies
    x, y = one.parts
    assert (one.episodes, one.steps, one.horizon, one.why) == (2, 5, 1, "all episodes")
    # |1 - x| is 1, 0, 1, 3, 3, and |1 - y| is always 1.
    assert [x.mean, y.mean] == pytest.approx([8 / 5, 1])
    # Before an episode's first command, `repeat` has the mean of the other episode: 4 and 1.
    assert x.baselines == pytest.approx({"repeat": 9 / 5, "mean": 15 / 5, "nearest": 13 / 5})
    # The standard deviations are 1.6 and sqrt(0.96).
    assert one.total.mean == pytest.approx((1 + 1 / np.sqrt(0.96)) / 2)
    assert [x.change, x.logged_change] == pytest.approx([0, 2 / 3])
    # The interval is that of two episodes, with the means 2/3 and 3.
    assert x.interval == pytest.approx((2 / 3, 3))
    assert (one.worst.episode, one.worst.step, one.worst.state) == (1, 0, {})
    assert one.agreement is None
    assert one.log_loss is None
    assert one.latency_ms is not None
    assert 0 < one.latency_ms[0] <= one.latency_ms[1]
    assert "Action error is not success" in found.caveat


def test_a_chunk_is_compared_with_what_followed(code: str) -> None:
    (one,) = mcaprl.action_errors(f"{code}:chunk", two_drives(), trust_code=True).policies
    assert one.horizon == 2
    # The second action, 0, beside 1 and 2 of the first episode, and 4 of the second.
    assert one.parts[0].by_horizon == pytest.approx([8 / 5, 7 / 3])


def test_actions_that_were_computed_elsewhere(code: str, tmp_path: Path) -> None:
    data = two_drives()
    folder = tmp_path / "predicted"
    folder.mkdir()
    for episode in data.episodes:
        rows = np.tile(np.array([[1, 1], [0, 0]], np.float32), (len(episode), 1, 1))
        np.save(folder / f"episode-{episode.index}.npy", rows)
    (own,) = mcaprl.action_errors(folder, data).policies
    (called,) = mcaprl.action_errors(f"{code}:chunk", data, trust_code=True).policies
    assert own.parts == called.parts
    assert own.latency_ms is None
    (folder / "episode-1.npy").unlink()
    (first,) = mcaprl.action_errors(folder, data).policies
    assert (first.episodes, first.why) == (1, "those in the folder, of 2")
    assert first.parts[0].mean == pytest.approx(2 / 3)
    np.save(folder / "episode-7.npy", np.zeros((2, 2)))
    with pytest.raises(PolicyError, match="no episode 7, but 2 episodes"):
        mcaprl.action_errors(folder, data)
    (folder / "episode-7.npy").unlink()
    np.save(folder / "episode-1.npy", np.array([{"x": print}], object), allow_pickle=True)
    with pytest.raises(PolicyError, match=r"episode-1\.npy cannot be read as an array of numbers"):
        mcaprl.action_errors(folder, data)


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("pilots:fails", PolicyError, "fails at episode 0 step 0: RuntimeError: no battery"),
        ("pilots:wrong", PolicyError, r"returns shape \(3, 3\), expected \(3, 2\), or"),
        ("pilots:nothing", UsageError, "cannot be imported"),
        ("nowhere:act", UsageError, "cannot be imported"),
        ("missing.onnx", McaprlError, "missing.onnx"),
    ],
)
def test_bad_policies_are_refused(
    code: str, name: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        mcaprl.action_errors(name, two_drives(), trust_code=True)


def test_code_needs_trust(code: str) -> None:
    with pytest.raises(UsageError, match="is Python code: pass `trust_code=True`"):
        mcaprl.action_errors(f"{code}:ones", two_drives())
    assert code not in sys.modules


def test_a_log_of_one_episode_has_no_other_commands(code: str) -> None:
    data = two_drives().filter(lambda episode: episode.index == 0)
    (one,) = mcaprl.action_errors(f"{code}:ones", data, trust_code=True).policies
    assert set(one.total.baselines) == {"repeat"}
    assert one.total.interval is None
    assert one.lines()[0] == "a single episode: not compared with repeat"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a log of CartPole, and a run that held out some of its episodes."""
    folder = tmp_path_factory.mktemp("compared")
    log = folder / "log.mcap"
    mcaprl.record("CartPole-v1", log, policy="random", episodes=20, seed=3)
    mcaprl.train(log, folder / "run", algo="bc", updates=50, held_out=0.2)
    return log, folder / "run"


def test_a_run_is_compared_on_what_it_held_out(trained: tuple[Path, Path]) -> None:
    log, folder = trained
    (one,) = mcaprl.action_errors(folder, log).policies
    data = mcaprl.open(log)
    assert (one.episodes, one.why) == (4, "held out of the training")
    assert one.agreement == pytest.approx(1 - one.parts[0].mean)
    again = mcaprl.action_errors(mcaprl.load_policy(folder), data).policies[0]
    assert (again.episodes, again.why) == (20, "all episodes")


def test_an_exported_model_has_the_errors_of_its_run(trained: tuple[Path, Path]) -> None:
    log, folder = trained
    model = folder / "policy.onnx"
    mcaprl.export(folder, model)
    exported, own = mcaprl.action_errors([model, mcaprl.load_policy(folder)], log).policies
    assert exported.parts[0].by_horizon == own.parts[0].by_horizon
    assert exported.worst == own.worst


def test_a_policy_of_stable_baselines3(trained: tuple[Path, Path], tmp_path: Path) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    model = sb3.DQN("MlpPolicy", "CartPole-v1", buffer_size=10, device="cpu", seed=0)
    model.save(tmp_path / "sb3.zip")
    data = mcaprl.open(trained[0])
    (one,) = mcaprl.action_errors(tmp_path / "sb3.zip", data).policies
    actions, _ = model.predict(data.observations, deterministic=True)
    assert one.agreement == pytest.approx((actions == data.actions).mean())


def test_the_command(
    trained: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, folder = trained
    ask = ["evaluate", str(folder), "random", "--data", str(log), "--updates", "5"]
    assert run([*ask, "--report", str(tmp_path / "report")]) == 0
    shown = capsys.readouterr().out
    assert "action error of run: 4 episodes, held out of the training" in shown
    assert "Action error is not success" in shown
    page = (tmp_path / "report" / "index.html").read_text()
    assert "the worst ten seconds" in page
    assert run([*ask, "--json"]) == 0
    found: Any = json.loads(capsys.readouterr().out)
    assert found["action_errors"]["policies"][0]["steps"] > 0
    assert {"estimates", "answers"} <= found.keys()
    model = folder / "policy.onnx"
    mcaprl.export(folder, model) if not model.exists() else None
    assert run(["evaluate", str(model), "--data", str(log), "--json"]) == 0
    assert json.loads(capsys.readouterr().out).keys() == {"action_errors"}


def test_a_chunked_run_has_errors_by_step(tmp_path: Path) -> None:
    data = two_drives()
    mcaprl.train(data, tmp_path / "run", algo="bc", updates=5, chunk=2, held_out=0)
    (one,) = mcaprl.action_errors(tmp_path / "run", data).policies
    assert one.horizon == 2
    assert one.why == "all episodes, which the run was trained on: it held none out"


def test_a_bag_by_its_mapping(
    code: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, mapping = write_rosbag2(tmp_path / "bag"), tmp_path / "robot.yaml"
    mapping.write_text(MAPPING)
    ask = [f"{code}:turn", str(bag), "--mapping", str(mapping), "--trust-code"]
    assert run(["evaluate", ask[0], "--data", *ask[1:], "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["action_errors"]["policies"]
    linear, angular = found["parts"]
    # Steps 0 to 3 and 5 to 8, with the speeds 0, 0.5, 1, 1.5 and 2.5, 3, 3.5, 4 as commands. Those
    # of the log are 1 in even steps, otherwise -1.
    assert (found["episodes"], found["steps"]) == (2, 8)
    assert found["period_ms"] == pytest.approx(100)
    assert angular["mean"] == pytest.approx((1 + 1.5 + 0 + 2.5 + 3.5 + 2 + 4.5 + 3) / 8)
    assert linear["mean"] == pytest.approx(0.5)
    # The mean of the other episode is 0; the nearest states are those of step 5 and of step 3.
    assert angular["baselines"] == pytest.approx({"repeat": 14 / 8, "mean": 1, "nearest": 1})
    out = tmp_path / "beside.mcap"
    assert run(["annotate", *ask[1:], "--policy", ask[0], "--out", str(out)]) == 0
    values = Topic(McapReader(out), "/rl/values")
    shown = values.read(("policy_action", "difference", "distance", "q"))
    assert ((values.times - START_NS) // STEP_NS).tolist() == [0, 1, 2, 3, 5, 6, 7, 8]
    assert shown["policy_action"][:, 1].tolist() == [0, 0.5, 1, 1.5, 2.5, 3, 3.5, 4]
    assert shown["difference"][:2].tolist() == [[-0.5, -1], [-0.5, 1.5]]
    # Half of the range of both parts is 2.
    assert shown["distance"][0] == pytest.approx(np.sqrt((0.25**2 + 0.5**2) / 2))
    assert np.isnan(shown["q"]).all()


def test_any_policy_is_shown_beside_the_log(
    code: str, trained: tuple[Path, Path], tmp_path: Path
) -> None:
    log, folder = trained
    data, model, predicted = mcaprl.open(log), tmp_path / "run.onnx", tmp_path / "chunks"
    mcaprl.export(folder, model)
    predicted.mkdir()
    # Chunks, of which the first action is shown; two steps have none.
    chunks = np.tile([1.0, 0.0], (data.episodes[3].length, 1))
    chunks[:2] = np.nan
    np.save(predicted / "episode-3.npy", chunks)
    names = [str(folder), str(model), f"{code}:push", str(predicted)]
    out = tmp_path / "out.mcap"
    topics = mcaprl.annotate(log, out, policy=names, trust_code=True).topics
    reader = McapReader(out)
    own, exported, pushed, given = (
        Topic(reader, topics[name]).read(("policy_action", "agrees", "preference"))
        for name in names
    )
    np.testing.assert_array_equal(exported["policy_action"], own["policy_action"])
    expected = data.observations[:, 2] > 0
    np.testing.assert_array_equal(pushed["policy_action"], expected)
    np.testing.assert_array_equal(pushed["agrees"], expected == data.actions)
    assert pushed["preference"].sum(1).tolist() == [1] * len(data)
    times = Topic(reader, topics[names[3]]).times
    np.testing.assert_array_equal(times, data.episodes[3].log_time_ns[2:-1])
    assert set(given["policy_action"]) == {1}
    np.save(predicted / "episode-3.npy", np.full(len(chunks), 2))
    with pytest.raises(PolicyError, match=r"an action is not in Discrete\(2\)"):
        mcaprl.annotate(log, tmp_path / "bad.mcap", policy=predicted)
    assert not (tmp_path / "bad.mcap").exists()
    with pytest.raises(UsageError, match="is Python code"):
        mcaprl.annotate(log, tmp_path / "bad.mcap", policy=names[2])


def test_a_policy_of_stable_baselines3_is_shown(trained: tuple[Path, Path], tmp_path: Path) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    model = sb3.PPO("MlpPolicy", "CartPole-v1", n_steps=8, batch_size=8, device="cpu", seed=0)
    model.save(tmp_path / "sb3.zip")
    mcaprl.annotate(trained[0], tmp_path / "out.mcap", policy=tmp_path / "sb3.zip")
    shown = Topic(McapReader(tmp_path / "out.mcap"), "/rl/values").read(("policy_action",))
    actions, _ = model.predict(mcaprl.open(trained[0]).observations, deterministic=True)
    np.testing.assert_array_equal(shown["policy_action"], actions)
