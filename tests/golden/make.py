"""Writes logs of format version 1 that every later version has to read.

`python -m tests.golden.make` writes only missing files and never replaces existing files.
`contents.json` describes the contents of each file, with a hash of each column's bytes.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv

import mcaprl
from mcaprl.recorder.format.reading import McapReader, Topic
from mcaprl.recorder.repair.recover import recover_log
from tests.support.damage.faults import KnownEpisodes, play
from tests.support.recordings import MIXED_SPACE, KnownCommands, ScriptedEnv, leaves_of, record

FOLDER = Path(__file__).parent
CONTENTS = FOLDER / "contents.json"
START_NS = 10**18


def every_space(path: Path, compression: str) -> None:
    """Record a Dict space with a leaf of each kind, including two images."""
    record(path, MIXED_SPACE, spaces.Box(-1, 1, (2,), np.float32), [3, 2], compression=compression)


def simple(path: Path, observation_space: spaces.Space[Any], action_space: Any) -> None:
    """Record a space with a single leaf."""
    record(path, observation_space, action_space, [2, 3, 1])


def appended(path: Path) -> None:
    """Record twice into one file."""
    space = spaces.Box(-1, 1, (2,), np.float32)
    record(path, space, spaces.Discrete(3), [3, 2])
    record(path, space, spaces.Discrete(3), [4], seed=7, append=True, start_time_ns=2 * START_NS)


def recovered(path: Path, *, keep_unfinished: bool) -> None:
    """Record a log, cut it off in the second episode after 8191 steps, and recover it."""
    whole = path.with_suffix(".whole")
    space = spaces.Box(-1, 1, (2,), np.float32)
    rows = [(np.full(2, step % 2, np.float32), 0.5, False, step == 8200) for step in range(8201)]
    episodes = [[*rows[:3], (*rows[3][:2], True, False)], rows]
    env = mcaprl.RecordMcap(
        ScriptedEnv(space, spaces.Discrete(2), episodes), whole, start_time_ns=START_NS
    )
    with closing(env):
        play(env)
        env.reset()
        for _ in range(8195):
            env.step(1)
        data = whole.read_bytes()
    whole.write_bytes(data[:-100])
    try:
        recover_log(whole, path, keep_unfinished=keep_unfinished)
    finally:
        whole.unlink()


def of_a_vector(path: Path) -> None:
    """Record a vector of two environments, with `/rl/learner`."""
    envs = SyncVectorEnv([KnownEpisodes, KnownEpisodes])
    env = mcaprl.RecordVecMcap(envs, path, policy_version=3, epsilon=0.5, start_time_ns=START_NS)
    with closing(env):
        env.reset(seed=4)
        for step in range(8):
            env.behavior_probs = np.array([0.5, 0.25])
            env.policy_version = step
            env.step(np.array([step % 4, (step + 1) % 4]))


def with_scene(path: Path) -> None:
    """Record all display topics of a sim."""
    env = mcaprl.RecordMcap(
        gym.make("mcaprl/LaneKeeping-v0"), path, policy="pilot", start_time_ns=START_NS
    )
    with closing(env):
        env.reset(seed=0)
        for _ in range(3):
            env.step(0)


def reported(path: Path) -> None:
    """Record one episode of an environment with given values."""
    with closing(mcaprl.RecordMcap(KnownEpisodes(), path, start_time_ns=START_NS)) as env:
        play(env)


def short_episodes(path: Path) -> None:
    """Record episodes with log lines in one chunk, and probabilities of some actions."""
    space = spaces.Box(-1, 1, (2,), np.float32)
    lengths = [1 + k % 3 for k in range(12)]
    episodes = [
        [(np.full(2, k / 4, np.float32), float(k), k == last, False) for k in range(last + 1)]
        for last in lengths
    ]
    env = mcaprl.RecordMcap(
        ScriptedEnv(space, spaces.Discrete(2), episodes), path, start_time_ns=START_NS
    )
    with closing(env):
        for length in lengths:
            env.reset()
            for step in range(length):
                if step == 1:
                    env.behavior_prob = 0.75
                env.step(step % 2)


def densities(path: Path) -> None:
    """Record actions of floats whose parts have names, with the densities of some of them."""
    with closing(mcaprl.RecordMcap(KnownCommands(), path, start_time_ns=START_NS)) as recorder:
        for episode in range(2):
            recorder.reset(seed=episode)
            for step in range(3):
                if (step, episode) != (1, 0):
                    recorder.behavior_log_prob = (-100.0, 0.0, 3.5)[step]
                recorder.step(np.array([step / 2 - 0.5, step], np.float32))


FILES: dict[str, Callable[[Path], None]] = {
    **{
        f"every-space-{name}": partial(every_space, compression=name)
        for name in ("zstd", "lz4", "none")
    },
    "box": lambda path: simple(
        path, spaces.Box(-np.inf, np.inf, (2, 3), np.float64), spaces.Discrete(3, start=-1)
    ),
    "discrete": lambda path: simple(path, spaces.Discrete(5), spaces.MultiDiscrete([3, 4])),
    "multi-discrete": lambda path: simple(
        path, spaces.MultiDiscrete([3, 4]), spaces.MultiBinary(3)
    ),
    "multi-binary": lambda path: simple(
        path, spaces.MultiBinary(4), spaces.Box(-1, 1, (), np.float32)
    ),
    "image": lambda path: simple(path, spaces.Box(0, 255, (9, 8, 3), np.uint8), spaces.Discrete(2)),
    "appended": appended,
    "recovered": partial(recovered, keep_unfinished=False),
    "recovered-unfinished": partial(recovered, keep_unfinished=True),
    "vector-of-environments": of_a_vector,
    "lane-with-scene": with_scene,
    "reported": reported,
    "short-episodes": short_episodes,
    "densities": densities,
}


def contents_of(path: Path) -> dict[str, Any]:
    """Return the reference contents of a log: values of episodes, hashes of columns."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = mcaprl.open(path)
    columns = {"actions": data.actions, "rewards": data.rewards, "terminated": data.terminated}
    columns |= {"truncated": data.truncated, **_behavior(path, data)}
    columns |= {f"observation {k}": leaf for k, leaf in enumerate(leaves_of(data.observations))}
    columns |= {f"next {k}": leaf for k, leaf in enumerate(leaves_of(data.next_observations))}
    columns["log_time_ns"] = np.concatenate([e.log_time_ns for e in data.episodes])
    return {
        "observation_space": str(data.observation_space),
        "action_space": str(data.action_space),
        "env_id": data.env_id,
        "episodes": [[e.length, e.total_reward, e.reason, e.seed, e.policy] for e in data.episodes],
        "columns": {name: _digest(column) for name, column in columns.items()},
    }


def _behavior(path: Path, data: mcaprl.Dataset) -> dict[str, np.ndarray[Any, Any]]:
    """Return the behavior column of a log by the name of the array.

    Logs of version 0.1.0 have probabilities of all actions; readers convert them to logarithms.
    """
    topic = Topic(McapReader(path), "/rl/step")
    if data.behavior_field.name in topic.fields:
        return {data.behavior_field.plural: data.behavior}
    rows = topic.read(("behavior_prob", "final"))
    probs = rows["behavior_prob"][~rows["final"].astype(bool)]
    expected = [np.float32(np.log(float(prob))) for prob in probs]
    assert data.behavior_log_probs.tolist() == expected
    return {"behavior_probs": probs}


def _digest(column: np.ndarray[Any, Any]) -> str:
    digest = hashlib.sha256(np.ascontiguousarray(column).tobytes()).hexdigest()[:16]
    return f"{column.dtype} {column.shape} {digest}"


def main() -> None:
    """Write the logs that are missing."""
    stated = json.loads(CONTENTS.read_text()) if CONTENTS.exists() else {}
    for name, write in FILES.items():
        path = FOLDER / f"{name}.mcap"
        if not path.exists():
            write(path)
            digest = hashlib.sha256(path.read_bytes()).hexdigest()
            stated[name] = {"sha256": digest, **contents_of(path)}
    CONTENTS.write_text(json.dumps(stated, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
