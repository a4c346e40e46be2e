"""Tests of training with viewers: the messages they receive, and unchanged results."""

from __future__ import annotations

import base64
import json
import math
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import UsageError
from mcaprl.online.live import TRAINING_LABELS, LiveTraining
from mcaprl.online.task import Task, choose_task
from mcaprl.online.train import train
from mcaprl.progress import TrainingProgress
from mcaprl.recorder.format import messages
from mcaprl.recorder.format.schema import message_dtype
from mcaprl.recorder.viewer.live_stream import Pace
from tests.support.layouts import Topics, check_panels
from tests.support.learner_topic import read_learner
from tests.support.watcher import Watcher

SHORT: dict[str, Any] = {
    "steps": 400,
    "envs": 4,
    "hidden": (8,),
    "learning_starts": 60,
    "eval_interval": 200,
    "eval_episodes": 2,
    "final_episodes": 2,
}


def silent(_: TrainingProgress) -> None:
    """A progress callback that does nothing."""


class Clock:
    """Clock that advances only by the seconds that a test passes."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_frames_stay_within_their_time_budget() -> None:
    clock = Clock()
    pace = Pace(share=0.02, period_s=0.1, clock=clock)
    shown = 0
    for _ in range(100_000):
        if pace.due():
            shown += 1
            pace.begin()
            clock.now_s += 0.003
            pace.pause()
            # The environment's step takes this time, which is not part of the frame.
            clock.now_s += 0.05
            pace.begin()
            clock.now_s += 0.001
            pace.end()
        clock.now_s += 0.001
    # A frame takes 4 ms, which may be 2 % of the time. The next frame is therefore due after 200
    # ms, not counting the environment's step of 50 ms.
    assert shown * 0.004 <= 0.02 * clock.now_s
    assert shown == pytest.approx(clock.now_s / 0.25, rel=0.02)


def test_the_frame_rate_is_limited() -> None:
    clock = Clock()
    pace = Pace(share=0.02, period_s=0.1, clock=clock)
    shown = 0
    while clock.now_s < 10:
        if pace.due():
            shown += 1
            pace.begin()
            pace.end()
        clock.now_s += 0.001
    assert shown == pytest.approx(100, abs=2)


def watched(task: Task, out: Path, **options: Any) -> Any:
    """Train, show each episode without delay, and return the messages that the viewer received."""
    every = Pace(share=1.0, period_s=0.0)
    with closing(LiveTraining(task, port=0, speed=math.inf, pace=every)) as live:
        watcher = Watcher(live.stream.url)
        train(task, out, live=live, progress=silent, **options)
    return watcher.seen()


@pytest.fixture(scope="module")
def viewed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    """Return the messages of a recorded training in the lane sim, and the folder of its files."""
    folder = tmp_path_factory.mktemp("viewed")
    task = Task.for_sim("lane", **SHORT)
    return watched(task, folder / "run", record=folder / "log.mcap"), folder


def decoded(seen: Any, topic: str) -> np.ndarray[Any, Any]:
    """Return the messages of a topic as an array; all of them must have the same length."""
    dtype = message_dtype(seen["topics"][topic]["schema"])
    assert dtype is not None
    found = [base64.b64decode(m["bytes"]) for m in seen["messages"] if m["topic"] == topic]
    return np.frombuffer(b"".join(found), dtype)


def test_a_viewer_receives_what_is_recorded(viewed: tuple[Any, Path]) -> None:
    """If no frame is skipped, viewers receive the logged transitions of the first environment."""
    seen, folder = viewed
    counts = Counter(message["topic"] for message in seen["messages"])
    each_step = {"/rl/step", "/rl/learner", "/rl/values", "/rl/training"}
    shown = {"/scene", "/telemetry", "/camera/depth"}
    assert {counts[topic] for topic in each_step | shown} == {100}
    # The frames of a step are sent with the next step, at the end of their motion.
    assert counts["/tf"] in (99, 100)
    assert counts["/scene/static"] >= 1
    steps, learner = decoded(seen, "/rl/step"), decoded(seen, "/rl/learner")
    log, reported = mcaprl.open(folder / "log.mcap"), read_learner(folder / "log.mcap")
    # The log contains the episodes of all environments, in the order in which they ended. Find the
    # steps of the first environment by their observations.
    places = {row.tobytes(): i for i, row in enumerate(log.observations)}
    rows = [places[observation.tobytes()] for observation in steps["observation"]]
    for name, column in (("reward", log.rewards), ("behavior_prob", log.behavior_probs)):
        np.testing.assert_array_equal(steps[name], column[rows], err_msg=name)
    np.testing.assert_array_equal(steps["action"], log.actions[rows])
    np.testing.assert_array_equal(steps["terminated"], log.terminated[rows])
    np.testing.assert_array_equal(learner["epsilon"], reported.epsilon[rows])
    np.testing.assert_array_equal(learner["policy_version"], reported.policy_version[rows])
    ends = [base64.b64decode(m["bytes"]) for m in seen["messages"] if m["topic"] == "/rl/episode"]
    assert len(ends) == len(np.flatnonzero(steps["terminated"][:-1]))
    first = messages.decode(ends[0], messages.EPISODE_TYPE)
    length = int(np.flatnonzero(steps["terminated"])[0]) + 1
    assert (first.episode, first.length, first.reason) == (steps["episode"][0], length, "off_lane")
    assert first.total_reward == pytest.approx(steps["reward"][:length].sum())


def test_a_shown_episode_has_its_trail(viewed: tuple[Any, Path]) -> None:
    seen, _ = viewed
    steps = decoded(seen, "/rl/step")["step"].tolist()
    scenes = [base64.b64decode(m["bytes"]) for m in seen["messages"] if m["topic"] == "/scene"]
    lengths = []
    for scene in scenes:
        markers = messages.decode(scene, "visualization_msgs/msg/MarkerArray").markers
        lengths.append(next(len(marker.points) for marker in markers if marker.ns == "trail"))
    # The trail begins with the first point twice, because a line needs two points. Each step adds a
    # point.
    assert lengths == [max(2, min(step + 1, 40)) for step in steps]


def test_values_and_metrics_are_those_of_the_learner(viewed: tuple[Any, Path]) -> None:
    seen, _ = viewed
    values, steps = decoded(seen, "/rl/values"), decoded(seen, "/rl/step")
    assert values["q"].shape == (100, 6)
    np.testing.assert_array_equal(values["policy_action"], values["q"].argmax(1))
    np.testing.assert_array_equal(values["agrees"], values["policy_action"] == steps["action"])
    np.testing.assert_allclose(values["value"], values["q"].max(1), rtol=1e-6)
    assert (values["q"][0] != values["q"][-1]).all(), "it learns"
    training = decoded(seen, "/rl/training")
    assert training.dtype.names == ("encapsulation", *TRAINING_LABELS)
    assert training["steps"].tolist() == list(range(0, 400, 4))
    assert np.isnan(training["loss"][:10]).all()
    assert (training["loss"][30:] > 0).all()
    assert training["epsilon"][0] == 1.0
    assert training["epsilon"][-1] == pytest.approx(0.05, rel=1e-3)
    assert np.isnan(training["score"][0])
    assert np.isfinite(training["score"][-1])


def test_viewing_changes_nothing(viewed: tuple[Any, Path], tmp_path: Path) -> None:
    _, folder = viewed
    task = Task.for_sim("lane", **SHORT)
    train(task, tmp_path / "run", record=tmp_path / "log.mcap", progress=silent)
    curves = [one / "run" / "seed-0" / "curve.csv" for one in (folder, tmp_path)]
    assert curves[0].read_text() == curves[1].read_text()
    logs = [mcaprl.open(one / "log.mcap") for one in (folder, tmp_path)]
    np.testing.assert_array_equal(logs[0].observations, logs[1].observations)
    np.testing.assert_array_equal(logs[0].behavior_probs, logs[1].behavior_probs)
    layout = json.loads((folder / "run" / "foxglove-layout.json").read_text())
    paths = layout["configById"]["Plot!loss"]["paths"]
    assert [path["value"] for path in paths] == ["/rl/training.loss"]
    assert "3D!scene" in layout["configById"]


@pytest.mark.parametrize(
    ("sim", "algo", "options"),
    [
        ("CartPole-v1", "ppo", {"rollout_steps": 40, "batch_size": 20}),
        ("powerline", "a2c", {"rollout_steps": 8}),
        ("racer", "dqn", {"learning_starts": 20, "frame_stack": 2}),
    ],
)
def test_other_algorithms_and_environments(
    tmp_path: Path, sim: str, algo: str, options: dict[str, Any]
) -> None:
    shared = {name: value for name, value in SHORT.items() if name != "learning_starts"}
    task = Task.for_sim(sim, algo, **{**shared, "steps": 80, "eval_interval": 80, **options})
    seen = watched(task, tmp_path / "run")
    steps, values = decoded(seen, "/rl/step"), decoded(seen, "/rl/values")
    assert len(steps) == len(values) == 20
    assert np.isnan(values["q"]).all() == (algo != "dqn")
    np.testing.assert_allclose(values["preference"].sum(1), 1.0, rtol=1e-5)
    assert ((values["entropy"] >= 0) & (values["entropy"] <= 1.0001)).all()
    assert ("/scene" in seen["topics"]) == (sim != "CartPole-v1")
    schemas = {
        topic: (found["schemaName"], found["schema"]) for topic, found in seen["topics"].items()
    }
    layout = json.loads((tmp_path / "run" / "foxglove-layout.json").read_text())
    check_panels(layout, Topics(schemas))
    # The most important metrics come first.
    for name in ("mean_return", "score"):
        (first,) = layout["configById"][f"Plot!training {name}"]["paths"]
        assert first["value"] == f"/rl/training.{name}"
    loss = layout["configById"]["Plot!loss"]["lichtblickPanelTitle"]
    assert loss == TRAINING_LABELS["loss"] == "loss of the last update"
    assert layout["configById"]["Tab!metrics"]["tabs"][0]["title"] == "mean q"


@pytest.mark.parametrize(
    ("sim", "algo", "engine"),
    [("lane", "sac", ""), ("Pendulum-v1", "td3", ""), ("lane", "sac", "sb3"), ("racer", "ppo", "")],
)
def test_the_commands_of_a_box_are_shown(tmp_path: Path, sim: str, algo: str, engine: str) -> None:
    options = {} if sim == "Pendulum-v1" else {"actions": "continuous"}
    given = {"rollout_steps": 40, "batch_size": 20} if algo == "ppo" else {"learning_starts": 40}
    short = {**SHORT, "steps": 80, "eval_interval": 80, "hidden": (8, 8)}
    del short["learning_starts"]
    task = choose_task(sim, algo, options, {**short, **given}, engine=engine or None)
    log = tmp_path / "log.mcap"
    seen = watched(task, tmp_path / "run", record=log)
    steps, values, data = decoded(seen, "/rl/step"), decoded(seen, "/rl/values"), mcaprl.open(log)
    assert len(steps) == len(values) == 20
    places = {row.tobytes(): i for i, row in enumerate(data.observations)}
    rows = [places[observation.tobytes()] for observation in steps["observation"]]
    taken, box = data.actions[rows], data.action_space
    assert isinstance(box, spaces.Box)
    np.testing.assert_array_equal(steps["action"], taken)
    np.testing.assert_array_equal(steps["behavior_log_prob"], data.behavior_log_probs[rows])
    np.testing.assert_array_equal(values["log_prob"], steps["behavior_log_prob"])
    assert ((values["policy_action"] >= box.low) & (values["policy_action"] <= box.high)).all()
    difference = values["policy_action"] - taken
    np.testing.assert_allclose(values["difference"], difference, rtol=1e-4, atol=1e-6)
    for name in ("q", "value", "advantage"):
        assert np.isfinite(values[name]).all() == (not task.is_sb3)
    schemas = {
        topic: (found["schemaName"], found["schema"]) for topic, found in seen["topics"].items()
    }
    layout = json.loads((tmp_path / "run" / "foxglove-layout.json").read_text())
    check_panels(layout, Topics(schemas))
    dials = [one for name, one in layout["configById"].items() if name.startswith("Gauge!action")]
    ends = [(one["minValue"], one["maxValue"]) for one in dials]
    assert ends == list(zip(box.low.tolist(), box.high.tolist(), strict=True))
    parts = {"lane": ["pedal", "steering"], "racer": ["acceleration", "turn"]}
    assert [one["lichtblickPanelTitle"] for one in dials] == parts.get(sim, ["action[0]"])


def test_the_command_prints_the_url(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = ["--steps", "16", "--envs", "4", "--eval-episodes", "1", "--final-episodes", "1"]
    out = tmp_path / "run"
    arguments = ["train-online", "lane", *short, "--out", str(out), "--live", "--port", "0"]
    assert run(arguments) == 0
    reported = capsys.readouterr().out
    assert "ws://127.0.0.1:" in reported
    assert f"layout to import: {out / 'foxglove-layout.json'}" in reported
    assert (out / "foxglove-layout.json").exists()


def test_a_port_in_use_is_refused() -> None:
    task = Task.for_sim("lane", **SHORT)
    with closing(LiveTraining(task, port=0)) as live:
        port = int(live.stream.url.rpartition(":")[2])
        with pytest.raises(UsageError, match=rf"cannot listen on 127.0.0.1:{port}.*`port=`"):
            LiveTraining(task, port=port)
