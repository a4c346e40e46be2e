"""Inputs that the fuzz changes, and the functions that read them.

Each function of `TARGETS` writes small valid examples into a folder. An example is a folder; one of
its files is changed, and then the calls of the example read it. A new kind of input is a new
example here.
"""

from __future__ import annotations

import functools
import json
import shutil
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

import mcaprl
from mcaprl.api.evaluate import learning_curves
from mcaprl.offline.selection.choice import read_choice
from mcaprl.ray.sweep import read_plan
from mcaprl.recorder.dataset.open import LogFile, write_manifest
from tests.offline.estimate.test_off_policy import log
from tests.recorder.bags.test_definition_files import write_database
from tests.support.bags import write_rosbag1, write_rosbag2
from tests.support.damage.datasets import dataset, write_all
from tests.support.damage.faults import write_log
from tests.support.nested_bags import FORMATS, motors
from tests.support.recordings import MIXED_SPACE, record

Call = Callable[[Path], Any]


class Example(NamedTuple):
    """A valid input.

    Attributes:
        folder: Folder with the input, which is copied.
        calls: Functions that read the copy; each may refuse it.
        files: Pattern of the files that are changed.
    """

    folder: Path
    calls: Sequence[Call]
    files: str = "**/*"


MAPPINGS = (
    """\
clock: {rate_hz: 10}
observation:
  speed: {field: /odom.twist.twist.linear.x, scale: 0.5, offset: 0.1, clip: [-4, 4]}
  place: {transform: base, in: odom, parts: [x, y, yaw], tolerance_s: 1.0}
  hip: {field: /joints.position, names: hip, align: linear}
fields:
  heading: {field: /odom.pose.pose.orientation, as: yaw, wrap_angle: true}
  count: {field: /joints, as: count}
stack: 2
action:
  fields: [/cmd_vel.linear.x, /cmd_vel.angular.z]
  actions: {left: [1, 1], right: [1, -1]}
  far: 0.25
reward: "next(speed) - speed + 0.1 * action if not terminated else -1"
episodes:
  begin: speed > 0.1
  terminated: abs(heading) > 3
  truncated: count > 100
  reasons: {fast: "speed > 9 and hip < 3", slow: "speed <= 0.01"}
  gap_s: 2.0
  max_steps: 8
meta: {env_id: Robot-v0, policy: driver}
strict: false
""",
    """\
time: header
clock: {topic: /odom, time: log_time}
observation:
  depth: {image: /camera/depth, crop: [0, 0, 4, 4], resize: [3, 2], range_m: [0.1, 9]}
  effort: {field: /joints.effort, pad: 3, missing: -1, names: []}
  covariance: {field: "/odom.pose.covariance[0:36:5]", pool: max, to: 3}
action:
  fields: [/cmd_vel.linear.x, /cmd_vel.angular.z]
  edges: [[0.5], [-0.5, 0.5]]
  align: nearest
  time: log_time
  tolerance_s: 1
episodes: {per: recording, min_steps: 3}
""",
    """\
clock: {rate_hz: 5}
observation:
  speed: {field: /odom.twist.twist.linear.x, time: {field: /odom.header.stamp, unit: s}}
action:
  expressions: ["next(speed) - speed", "min(speed, 1)"]
  box: {low: [-1, -1], high: [1, 1]}
reward: speed ** 2
""",
)


def mapping_files(root: Path) -> list[Example]:
    """Mapping files, beside a valid bag."""
    examples: list[Example] = []
    for number, text in enumerate(MAPPINGS):
        folder = root / str(number)
        write_rosbag2(folder / "bag")
        (folder / "mapping.yaml").write_text(text)
        examples.append(Example(folder, [_convert_mapped], "*.yaml"))
    return examples


def _convert_mapped(folder: Path) -> None:
    found = mcaprl.convert(mcaprl.open(folder / "bag", mapping=folder / "mapping.yaml"), None)
    assert len(found.dataset) == len(found.dataset.rewards)
    for part in (found.to_json(), found.first_table(), found.run_table()):
        json.dumps(part)


FILTER = "length > 5 and total_reward <= 3.5 or not terminated and reason == 'x' or -duration_s < 1"
REWARD = (
    "max(speed, x[0]) - min(abs(next(x[1])), 2) ** 2 / 3 if speed < 1 and not x[0] >= 7 else -1"
)


def expressions(root: Path) -> list[Example]:
    """Conditions of `filter`, and rewards of a mapping."""
    for name, text in (("filter", FILTER), ("reward", REWARD)):
        (root / name).mkdir()
        (root / name / "expression").write_text(text)
    write_log(root / "filter/log.mcap", 3)
    write_rosbag2(root / "reward/bag")
    return [
        Example(root / "filter", [_filter], "expression"),
        Example(root / "reward", [_reward], "expression"),
    ]


def _filter(folder: Path) -> None:
    mcaprl.filter(_text(folder), folder / "log.mcap", folder / "out.mcap")


def _reward(folder: Path) -> None:
    tree = {
        "clock": {"rate_hz": 10},
        "observation": {"x": {"field": "/joints.position"}},
        "fields": {"speed": {"field": "/odom.pose.pose.position.x"}},
        "action": {"fields": ["/cmd_vel.angular.z"], "edges": [[0]]},
        "reward": _text(folder),
    }
    mcaprl.open(folder / "bag", mapping=tree)


def _text(folder: Path) -> str:
    return (folder / "expression").read_text(errors="replace")


READ_BAG: list[Call] = [
    lambda folder: mcaprl.info(folder / "bag"),
    lambda folder: mcaprl.check(folder / "bag"),
    lambda folder: mcaprl.suggest_mapping(folder / "bag"),
]


def ros2_bags(root: Path) -> list[Example]:
    """ROS 2 bags in MCAP and SQLite, plain and compressed."""
    write_rosbag2(root / "mcap/bag")
    write_rosbag2(root / "sqlite/bag", "sqlite3")
    write_rosbag2(root / "file/bag", "mcap", "FILE")
    write_rosbag2(root / "message/bag", "sqlite3", "MESSAGE")
    examples: list[Example] = []
    for folder in sorted(root.iterdir()):
        (folder / "mapping.yaml").write_text(MAPPINGS[len(examples) % 2])
        calls = [*READ_BAG, _convert_mapped]
        examples.append(Example(folder, calls, "bag/*"))
    return examples


DEFINITIONS = {
    "msg/Robot.msg": """\
# A robot
uint8 MODE=3
float64 x
acme_msgs/Motor[2] motors
float32[<=4] speeds [1.0, 2.0]
string<=5 name "x"
""",
    "msg/Motor.idl": """\
module acme_msgs { module msg {
  typedef float float__2[2];
  @verbatim (language="comment", text="A motor")
  struct Motor { @default (value=0.5) double q; float__2 pose; };
}; };
""",
    "srv/Set.srv": "bool on\n---\nbool ok\n",
}


def definition_files(root: Path) -> list[Example]:
    """Definitions of the types of a bag without definitions."""
    rows = [struct.pack("<d4d2I", k, *[0.5] * 4, 0, 1) + b"\0" for k in range(3)]
    write_database(root / "old.db3", [("/robot", "acme_msgs/msg/Robot", rows)])
    for name, text in DEFINITIONS.items():
        path = root / "acme_msgs" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return [Example(root, [_info_with_definitions, _draft_with_definitions], "acme_msgs/*/*")]


def _info_with_definitions(folder: Path) -> None:
    mcaprl.info(folder / "old.db3", definitions=[folder / "acme_msgs"])


def _draft_with_definitions(folder: Path) -> None:
    mcaprl.suggest_mapping(folder / "old.db3", definitions=[folder / "acme_msgs"])


def ros1_bags(root: Path) -> list[Example]:
    """ROS 1 bags."""
    (root / "one/bag").mkdir(parents=True)
    write_rosbag1(root / "one/bag/a.bag")
    (root / "one/mapping.yaml").write_text(MAPPINGS[0])
    return [Example(root / "one", [*READ_BAG, _convert_mapped], "bag/*")]


def json_and_protobuf_bags(root: Path) -> list[Example]:
    """Bags of JSON, with and without a schema, and of protobuf."""
    rows = [
        {
            "motors": motors(("a", 1.0 * step), ("b", 2.0)),
            "joint_names": ["hip", "knee"],
            "position": [0.1 * step, 2.0],
            "points": [{"positions": [1.0, 2.0]}],
            "ranges": [1.0] * 5,
            "command": float(step % 3),
        }
        for step in range(6)
    ]
    tree = {
        "clock": {"rate_hz": 1},
        "observation": {
            "hip": {"field": "/low.position", "names": ["hip"]},
            "motors": {"field": "/low.motors[0:2].q"},
            "ranges": {"field": "/low.ranges", "pool": "min", "to": 2},
        },
        "action": {"fields": ["/low.command"], "edges": [[0.5]]},
    }
    examples = []
    for kind in ("protobuf", "JSON with schema", "JSON"):
        folder = root / kind
        (folder / "bag").mkdir(parents=True)
        FORMATS[kind](folder / "bag", rows)
        (folder / "mapping.yaml").write_text(json.dumps(tree))
        # A draft needs a schema.
        calls = [*(READ_BAG[:2] if kind == "JSON" else READ_BAG), _convert_mapped]
        examples.append(Example(folder, calls, "bag/*"))
    return examples


SWEEP = """\
algos: {bc: {}, cql: {alpha: [0.1, 1]}}
settings:
  updates: 400
  learning_rate: [3e-4, 1e-3]
  hidden: [[8], [16, 16]]
  batch_size: 8
seeds: 2
seed: 0
score: {every: 100, fraction: 0.2, updates: 100, epsilon: 0.1, gamma: 0.97}
stop: 3
"""


def sweep_files(root: Path) -> list[Example]:
    """Sweep files in YAML and JSON."""
    (root / "sweep.yaml").write_text(SWEEP)
    tree = {"algos": ["bc"], "settings": {"updates": [1, 2]}}
    (root / "sweep.json").write_text(json.dumps(tree))
    return [Example(root, [_read_plans], "sweep.*")]


def _read_plans(folder: Path) -> None:
    for path in sorted(folder.glob("sweep.*")):
        read_plan(path)


def logs(root: Path) -> list[Example]:
    """Logs of this package, alone and in a folder with a manifest."""
    for name in ("mixed", "known", "listed"):
        (root / name / "logs").mkdir(parents=True)
    record(root / "mixed/logs/a.mcap", MIXED_SPACE, spaces.Discrete(2), [3, 2])
    write_log(root / "known/logs/a.mcap", 3)
    record(root / "listed/logs/a.mcap", spaces.Box(-1, 1, (2,)), spaces.Discrete(2), [3, 2])
    size = (root / "listed/logs/a.mcap").stat().st_size
    write_manifest(root / "listed/logs", [LogFile("a.mcap", 2, 5, size)])
    calls: list[Call] = [
        lambda folder: repr(mcaprl.open(folder / "logs").statistics),
        lambda folder: mcaprl.info(folder / "logs"),
        lambda folder: mcaprl.check(folder / "logs"),
        lambda folder: mcaprl.recover(folder / "logs/a.mcap", folder / "whole.mcap"),
        lambda folder: mcaprl.slice(folder / "logs/a.mcap", folder / "cut.mcap", steps=(1, 3)),
        lambda folder: mcaprl.convert(folder / "logs", folder / "out.npz", to="npz", lossy=True),
    ]
    examples = [Example(root / name, calls, "logs/a.mcap") for name in ("mixed", "known")]
    return [*examples, Example(root / "listed", [_info_of_manifest], "logs/*.json")]


def _info_of_manifest(folder: Path) -> None:
    mcaprl.info(folder / "logs/manifest.json")


def logs_of_sims(root: Path) -> list[Example]:
    """Logs of a sim with scene and infos: shown, verified and continued."""
    log = root / "log.mcap"
    mcaprl.record("lane", log, episodes=2, max_steps=4, infos=True)
    calls: list[Call] = [
        lambda folder: repr(mcaprl.open(folder / "log.mcap").infos),
        lambda folder: mcaprl.layout(folder / "log.mcap", folder / "layout.json"),
        lambda folder: mcaprl.save_page(folder / "log.mcap", folder / "page.html"),
        lambda folder: mcaprl.verify(folder / "log.mcap"),
        lambda folder: mcaprl.convert(folder / "log.mcap", folder / "out.hdf5", to="hdf5"),
        lambda folder: mcaprl.record(
            "lane", folder / "log.mcap", episodes=1, max_steps=2, infos=True, append=True
        ),
    ]
    return [Example(root, calls)]


def _datasets(*wanted: str) -> Callable[[Path], list[Example]]:
    """Return the target of the datasets of other tools in some forms."""

    def write(root: Path) -> list[Example]:
        found = []
        for name, (form, path) in write_all(_made(root / "all")).items():
            if name.split()[0] not in wanted:
                continue
            folder = root / name.replace(" ", "-")
            folder.mkdir()
            shutil.move(path, folder / path.name)
            read = functools.partial(_open_foreign, name=path.name, form=form)
            found.append(Example(folder, [read]))
        return found

    return write


def _open_foreign(folder: Path, name: str, form: str) -> None:
    found = mcaprl.open(folder / name, format=form)
    assert len(found) == len(found.rewards) == found.episode_lengths.sum()
    assert len(repr(found.statistics)) > 0
    mcaprl.convert(found, folder / "out.mcap", overwrite=True)
    mcaprl.info(folder / "out.mcap")


TINY: dict[str, Any] = {
    "updates": 4,
    "batch_size": 4,
    "hidden": (4,),
    "checkpoint_interval": 2,
    "log_interval": 1,
}


class Stopped(mcaprl.McaprlError):
    """Ends a training that a changed setting would continue for long."""


def _stop(progress: Any) -> None:
    if progress.done > 8:
        raise Stopped


def policies(root: Path) -> list[Example]:
    """Trained policies of offline runs."""
    dataset().save(root / "log.mcap")
    examples = []
    for algo in ("dqn", "bcq"):
        folder = root / algo
        mcaprl.train(root / "log.mcap", folder / "run", algo=algo, **TINY)
        shutil.copy(root / "log.mcap", folder)
        calls = [_act, _annotate]
        examples.append(Example(folder, calls, "run/seed-0/policy.*"))
    return examples


def _act(folder: Path) -> None:
    (path,) = folder.glob("run*")
    policy = mcaprl.load_policy(path)
    space = policy.observation_space
    observations = np.zeros((3, 2), np.float32)
    if space is not None and space.shape == (2,):
        policy.begin()
        policy.act(observations)
        if policy.frame_stack == 1:
            policy.action_probabilities(observations)


def _annotate(folder: Path) -> None:
    mcaprl.annotate(
        folder / "log.mcap", folder / "out.mcap", policy=str(folder / "run"), overwrite=True
    )


def sb3_policies(root: Path) -> list[Example]:
    """Policies that Stable-Baselines3 and this package wrote."""
    import gymnasium as gym
    from stable_baselines3 import DQN, PPO

    from mcaprl.online.zip_file import describe_run, save_policy

    examples = []
    for kind in (DQN, PPO):
        env = gym.make("CartPole-v1")
        small: Any = {"device": "cpu", "policy_kwargs": {"net_arch": [4]}}
        model = kind("MlpPolicy", env, **small)
        for author in ("sb3", "own"):
            folder = root / f"{kind.__name__}-{author}"
            folder.mkdir(parents=True)
            if author == "sb3":
                model.save(folder / "run.zip")
            else:
                described = describe_run(
                    "dqn", (4,), env.observation_space, env.action_space, "CartPole-v1", {}
                )
                save_policy(folder / "run.zip", model, described)
            examples.append(Example(folder, [_load_and_evaluate]))
    return examples


def _load_and_evaluate(folder: Path) -> None:
    mcaprl.load_policy(folder / "run.zip")
    mcaprl.evaluate(folder / "run.zip", "CartPole-v1", episodes=2, max_steps=3)


def runs(root: Path) -> list[Example]:
    """Offline runs that are resumed, compared and drawn."""
    folder = root / "cql"
    folder.mkdir()
    dataset().save(folder / "log.mcap")
    mcaprl.train(folder / "log.mcap", folder / "run", algo="cql", **TINY)
    return [Example(folder, [_resume, _curves, _annotate], "run/**/*")]


def _resume(folder: Path) -> None:
    mcaprl.train(folder / "log.mcap", folder / "run", resume=True, progress=_stop)


def _curves(folder: Path) -> None:
    learning_curves([str(folder / "run")])


def auto_runs(root: Path) -> list[Example]:
    """Runs of `auto`, whose choice is read and which are resumed."""
    settings = {**TINY, "updates": 8, "survivors": 1, "model_updates": 8, "target_interval": 2}
    folder = root / "auto"
    folder.mkdir()
    log(12).save(folder / "log.mcap")
    mcaprl.train(folder / "log.mcap", folder / "run", algo="auto", **settings)
    return [Example(folder, [_choice_page, _resume], "run/*.json")]


def _choice_page(folder: Path) -> None:
    read_choice(folder / "run").write_report(folder / "page", "x")


def online_runs(root: Path) -> list[Example]:
    """Online runs that are resumed and drawn."""
    settings: Any = {
        "steps": 20,
        "hidden": (4,),
        "eval_interval": 10,
        "eval_episodes": 1,
        "final_episodes": 1,
        "learning_starts": 4,
        "target_update_interval": 4,
        "checkpoint_interval": 10,
        "buffer_size": 50,
    }
    mcaprl.train_online("CartPole-v1", root / "run", max_steps=5, **settings)
    calls: list[Call] = [
        lambda folder: mcaprl.train_online(None, folder / "run", resume=True, progress=_stop),
        _curves,
        lambda folder: mcaprl.load_policy(folder / "run"),
    ]
    return [Example(root, calls, "run/**/*")]


def sweeps(root: Path) -> list[Example]:
    """Folders of sweeps that are resumed."""
    from mcaprl.ray import sweep as module

    plan = read_plan({"algos": ["bc"], "settings": {"updates": 4}})
    identity = {
        "trials": [["bc-000", "bc", {}]],
        "seeds": [0, 1],
        "score": {},
        "data": [["a", "0", 1.0]],
    }
    module._open(root, identity, resume=False)
    scores = [module.Score(2, [0.5], "FQE", True), module.Score(4, [0.25], "WDR", False)]
    module._save(root / "bc-000", scores, "")

    def result(folder: Path) -> None:
        from mcaprl.ray.sweep import write_sweep

        (trial,) = plan.trials
        write_sweep([module._result(trial, folder)], plan, folder / "out")

    calls: list[Call] = [lambda folder: module._open(folder, identity, resume=True), result]
    return [Example(root, calls, "*.json")]


TARGETS: dict[str, Callable[[Path], list[Example]]] = {
    "mapping files": mapping_files,
    "expressions": expressions,
    "ROS 2 bags": ros2_bags,
    "definition files": definition_files,
    "ROS 1 bags": ros1_bags,
    "JSON and protobuf bags": json_and_protobuf_bags,
    "sweep files": sweep_files,
    "logs": logs,
    "logs of sims": logs_of_sims,
    "npz": _datasets("npz"),
    "HDF5": _datasets("hdf5", "d3rlpy", "robomimic"),
    "Minari": _datasets("minari"),
    "Parquet and LeRobot": _datasets("parquet", "lerobot"),
    "policies": policies,
    "SB3 policies": sb3_policies,
    "runs": runs,
    "auto runs": auto_runs,
    "online runs": online_runs,
    "sweeps": sweeps,
}


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder
