"""Tasks of the suite: environments, behavior policies, and logs that are made from seeds.

    python -m benchmarks.suite.tasks CartPole     # trains the policies of behaviors/ again

The behaviors of a task are three stages of one online training, `early`, `medium` and `expert`,
which are in behaviors/TASK/STAGE with weights of 16 bits, or a scripted `pilot`. The file
behaviors/TASK.json has the returns that the logs must have, and the returns of random actions and
of the best behavior, which are the scores 0 and 1.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import shutil
import warnings
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

import benchmarks.suite.environments  # noqa: F401
import mcaprl
from benchmarks.studies.pendulum_data import pilot as pendulum_pilot
from mcaprl.files import write_json
from mcaprl.progress import TrainingProgress
from mcaprl.sims import PolicyScore, evaluate, make_pilot, make_sim, make_sims

HERE: Final = Path(__file__).parent
BEHAVIORS: Final = HERE / "behaviors"
EPISODES, EPISODE_SEED = 20, 1_000_000
QUANTILES: Final = (0, 25, 50, 75, 100)


class Part(NamedTuple):
    """A share of a log: a behavior, with a share of random actions or a largest deviation of noise.

    Attributes:
        behavior: `random`, `pilot`, or a stage of the training.
        epsilon: Probability of a random action.
        noise: Largest deviation of the noise on the actions of a Box; drawn for each episode.
    """

    behavior: str
    epsilon: float = 0.0
    noise: float = 0.0


@dataclass(frozen=True)
class Task:
    """An environment with the settings of its logs and of learning from them.

    Attributes:
        sim: Short name of a sim, or Gymnasium id.
        tier: `tests`, `study` or `release`.
        gamma: Discount of the learners.
        options: Arguments of the environment.
        steps: Transitions of each log.
        online: Settings of the online training of the behaviors; empty if there is a pilot.
        stages: Mean returns at which the training is `early` and `medium`.
        pilot: Function that makes the scripted pilot of an environment of Gymnasium.
        noise: Largest deviation of the noise of the noisy expert.
        needs: Package of the environment.
    """

    sim: str
    tier: str
    gamma: float = 0.99
    options: dict[str, Any] = field(default_factory=dict)
    steps: int = 20_000
    online: dict[str, Any] = field(default_factory=dict)
    stages: tuple[float, float] = (0.0, 0.0)
    pilot: Callable[[Any], Any] | None = None
    noise: float = 0.3
    needs: str = ""

    @property
    def kinds(self) -> dict[str, tuple[Part, ...]]:
        """Parts of each log, which have equal shares of the transitions."""
        if not self.online:
            mixed = (Part("random"), *(Part("pilot", epsilon) for epsilon in (0.6, 0.3, 0.1)))
            medium, expert = Part("pilot", 0.4), "pilot"
        else:
            mixed = (Part("random"), Part("early", 0.2), Part("medium", 0.2), Part("expert", 0.1))
            medium, expert = Part("medium", 0.1), "expert"
        is_box = isinstance(space_of(self), gym.spaces.Box)
        noisy = Part(expert, 0.0, self.noise) if is_box else Part(expert, 0.3)
        return {
            "random": (Part("random"),),
            "medium": (medium,),
            "replay": mixed,
            "medium-expert": (medium, Part(expert)),
            "noisy-expert": (noisy,),
        }

    @property
    def default_kinds(self) -> tuple[str, ...]:
        """Kinds of the logs that are learned from unless others are requested."""
        return ("replay", "noisy-expert") if self.tier == "tests" else tuple(self.kinds)

    @property
    def is_installed(self) -> bool:
        """Whether the package of the environment is installed."""
        return not self.needs or importlib.util.find_spec(self.needs) is not None


class Scripted(NamedTuple):
    """Policy of a function of one observation.

    Attributes:
        rule: Function of an observation.
    """

    rule: Callable[[NDArray[Any]], Any]
    is_deterministic: bool = True

    def act(self, observations: NDArray[Any]) -> NDArray[Any]:
        """Return the actions of the observations."""
        return np.array([self.rule(one) for one in observations])


def lander(env: Any) -> Scripted:
    """Return the scripted policy of Gymnasium's lunar lander."""
    from gymnasium.envs.box2d.lunar_lander import heuristic

    dtype = np.float32 if env.unwrapped.continuous else np.int64
    choose: Any = heuristic
    return Scripted(lambda seen: np.asarray(choose(env.unwrapped, seen), dtype))


def swing(_: Any) -> Scripted:
    """Return the pilot of the pendulum."""
    return Scripted(lambda seen: np.array([pendulum_pilot(seen)], np.float32))


def paddle(_: Any) -> Scripted:
    """Return a pilot of Breakout that moves the paddle to where the falling ball will land.

    While the ball rises, the paddle follows it.
    """

    def move(seen: NDArray[np.uint8]) -> np.int64:
        (row, column), (last_row, last), (_, place) = (
            np.argwhere(seen[..., channel])[0] for channel in (1, 2, 0)
        )
        step = int(column - last) or (1 if column == 0 else -1)
        # The ball bounces off the paddle below the cell that it is in before the last row.
        for _ in range(8 - row if row > last_row else 0):
            column, step = (column + step, step) if 0 <= column + step <= 9 else (column, -step)
        return np.int64(0 if column == place else 2 if column > place else 1)

    return Scripted(move)


def navigator(env: Any) -> Scripted:
    """Return the navigator that made the data sets of `ogbench`, without its noise.

    It moves toward the middle of the next cell on a shortest path.
    """
    maze = env.unwrapped

    def move(seen: NDArray[Any]) -> Any:
        offset = maze.get_oracle_subgoal(seen, maze.cur_goal_xy)[0] - seen
        return (offset / (np.linalg.norm(offset) + 1e-6)).astype(np.float32)

    return Scripted(move)


def arm_pilot(policy: str) -> Callable[[Any], Scripted]:
    """Return the function that makes a scripted policy of `metaworld`."""

    def make(_: Any) -> Scripted:
        script = getattr(importlib.import_module("metaworld.policies"), policy)()

        def move(seen: NDArray[Any]) -> Any:
            # It warns of actions that have to be clipped.
            with warnings.catch_warnings(action="ignore"):
                return np.clip(script.get_action(seen), -1, 1).astype(np.float32)

        return Scripted(move)

    return make


_DQN: Final[dict[str, Any]] = {
    "algo": "double-dqn",
    "hidden": (64, 64),
    "learning_rate": 1e-3,
    "final_learning_rate_fraction": 0.04,
    "batch_size": 64,
    "learning_starts": 1_000,
    "steps_per_update": 2,
    "target_update_interval": 500,
    "exploration_fraction": 0.2,
    "eval_interval": 2_000,
    "eval_episodes": 20,
    "final_episodes": 20,
}
_SAC: Final[dict[str, Any]] = {
    "algo": "sac",
    "hidden": (64, 64),
    "learning_rate": 1e-3,
    "batch_size": 128,
    "polyak": 0.02,
    "learning_starts": 1_000,
    "steps_per_update": 2,
    "eval_interval": 2_000,
    "eval_episodes": 10,
    "final_episodes": 20,
}
_STICKS: Final = {"actions": "continuous"}
_MUJOCO: Final[dict[str, Any]] = {"needs": "mujoco", "steps": 200_000}
TASKS: Final[dict[str, Task]] = {
    "CartPole": Task(
        "CartPole-v1", "tests", online=_DQN | {"n_steps": 3, "steps": 60_000}, stages=(60, 200)
    ),
    "Pendulum": Task("Pendulum-v1", "tests", 0.97, pilot=swing),
    "Acrobot": Task("Acrobot-v1", "study", online=_DQN | {"steps": 40_000}, stages=(-350, -180)),
    "MountainCar": Task(
        "MountainCar-v0",
        "study",
        pilot=lambda _: Scripted(lambda seen: np.int64(2 if seen[1] > 0 else 0)),
    ),
    "LunarLander": Task("LunarLander-v3", "study", pilot=lander, needs="Box2D"),
    "Breakout": Task("Breakout-v1", "study", pilot=paddle, needs="minatar"),
    "lane": Task("lane", "study", 0.97),
    "powerline": Task("powerline", "study", 0.97),
    "racer": Task("racer", "study", 0.98),
    "InvertedPendulum": Task(
        "InvertedPendulum-v5",
        "study",
        online=_SAC | {"steps": 12_000, "eval_interval": 1_000},
        stages=(100, 300),
        needs="mujoco",
    ),
    "Reacher": Task(
        "Reacher-v5",
        "study",
        0.97,
        online=_SAC | {"steps": 20_000},
        stages=(-20, -10),
        needs="mujoco",
    ),
    "PointMaze": Task("PointMaze-v0", "study", pilot=navigator, noise=0.5, needs="ogbench"),
    "Reach": Task("Reach-v3", "study", pilot=arm_pilot("SawyerReachV3Policy"), needs="metaworld"),
    "DrawerOpen": Task(
        "DrawerOpen-v3", "study", pilot=arm_pilot("SawyerDrawerOpenV3Policy"), needs="metaworld"
    ),
    "LunarLanderContinuous": Task("LunarLanderContinuous-v3", "study", pilot=lander, needs="Box2D"),
    "lane sticks": Task("lane", "study", 0.97, _STICKS, noise=0.1),
    "powerline sticks": Task("powerline", "study", 0.97, _STICKS, noise=0.1),
    "racer sticks": Task("racer", "study", 0.98, _STICKS),
    "Hopper": Task(
        "Hopper-v5", "release", online=_SAC | {"steps": 200_000}, stages=(500, 1_500), **_MUJOCO
    ),
    "HalfCheetah": Task(
        "HalfCheetah-v5", "release", online=_SAC | {"steps": 200_000}, stages=(1e3, 2e3), **_MUJOCO
    ),
    "Walker2d": Task(
        "Walker2d-v5", "release", online=_SAC | {"steps": 200_000}, stages=(500, 1_500), **_MUJOCO
    ),
}
"""All tasks by name."""


def space_of(task: Task) -> gym.Space[Any]:
    """Return the action space of a task."""
    with closing(make_sim(task.sim, **task.options)) as env:
        return env.action_space


def recorded_path(name: str) -> Path:
    """Return the file with the returns of a task."""
    return BEHAVIORS / f"{name.replace(' ', '-')}.json"


def read_recorded(name: str) -> dict[str, Any]:
    """Return the returns of a task that are known."""
    path = recorded_path(name)
    found: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    return found


def behavior(name: str, part: str, env: gym.Env[Any, Any]) -> Any:
    """Return a behavior of a task as a policy, or as the name `random`."""
    if part == "random":
        return part
    if part != "pilot":
        return mcaprl.load_policy(BEHAVIORS / name / part)
    make = TASKS[name].pilot
    return make_pilot(env) if make is None else make(env)


def make_log(name: str, kind: str, folder: Path) -> mcaprl.Dataset:
    """Record a log in FOLDER/TASK/KIND, if it is not there, and check its returns.

    Raises:
        ValueError: The returns of the episodes are not those of behaviors/TASK.json.
    """
    task, out = TASKS[name], folder / name / kind
    if not out.exists():
        shutil.rmtree(part := out.with_suffix(".part"), ignore_errors=True)
        part.mkdir(parents=True)
        parts = task.kinds[kind]
        for number, each in enumerate(parts):
            with closing(make_sim(task.sim, **task.options)) as env:
                mcaprl.record(
                    env,
                    part / f"{number}.mcap",
                    policy=behavior(name, each.behavior, env),
                    epsilon=each.epsilon,
                    noise=each.noise,
                    noise_per_episode=each.noise > 0,
                    steps=task.steps // len(parts),
                    seed=list(task.kinds).index(kind) * 10 + number,
                    scene=False,
                )
        part.rename(out)
    data = mcaprl.open(out)
    check_returns(name, kind, [float(each.rewards.sum()) for each in data.episodes])
    return data


def check_returns(name: str, kind: str, returns: list[float]) -> None:
    """Compare the returns of a log with behaviors/TASK.json; add them if they are not there.

    Raises:
        ValueError: They differ by more than a thousandth.
    """
    found: dict[str, Any] = {"episodes": len(returns), "mean": float(np.mean(returns))}
    found["quantiles"] = np.percentile(returns, QUANTILES).tolist()
    recorded = read_recorded(name)
    logs = recorded.setdefault("logs", {})
    if kind not in logs:
        logs[kind] = found
        write_json(recorded_path(name), recorded)
        return
    known = logs[kind]
    mine, theirs = (np.array([each["mean"], *each["quantiles"]]) for each in (found, known))
    if found["episodes"] != known["episodes"] or not np.allclose(mine, theirs, rtol=1e-3):
        raise ValueError(
            f"the log {name}, {kind} has {found['episodes']} episodes with a mean return of"
            f" {found['mean']:.2f}, and {recorded_path(name).name} has {known['episodes']} with"
            f" {known['mean']:.2f}: other versions of the packages make other logs"
        )


def scale(name: str) -> tuple[float, float]:
    """Return the mean returns that are the scores 0 and 1: random actions, and the best behavior.

    They are computed once, and stored in behaviors/TASK.json.
    """
    known = read_recorded(name)
    if "scale" not in known:
        task = TASKS[name]
        best = "expert" if task.online else "pilot"
        with closing(make_sim(task.sim, **task.options)) as env:
            arguments: dict[str, Any] = {"name": "", "episodes": 50, "seed": EPISODE_SEED}
            random = evaluate(env, [None], **arguments).mean_return
            known["scale"] = [
                random,
                evaluate(env, [behavior(name, best, env)], **arguments).mean_return,
            ]
        write_json(recorded_path(name), known)
    first, second = known["scale"]
    return first, second


def score(name: str, policies: Any) -> PolicyScore:
    """Run the same episodes for each policy."""
    task = TASKS[name]
    with (
        closing(make_sim(task.sim, **task.options)) as env,
        closing(make_sims(task.sim, EPISODES, **task.options)) as envs,
    ):
        return evaluate(env, policies, name="", episodes=EPISODES, seed=EPISODE_SEED, envs=envs)


def train_behaviors(name: str, folder: Path) -> None:
    """Train online, and write the policy of each stage to behaviors/TASK/STAGE."""
    task, out = TASKS[name], folder / "online" / name
    shutil.rmtree(out, ignore_errors=True)
    reached = dict(zip(("early", "medium"), task.stages, strict=True))

    def keep(now: TrainingProgress) -> None:
        for stage, least in list(reached.items()):
            if now.terms["mean_return"] >= least:
                write_behavior(out / "seed-0", BEHAVIORS / name / stage)
                del reached[stage]

    (summary,) = mcaprl.train_online(
        task.sim, out, progress=keep, sim_options=task.options, **task.online
    )
    write_behavior(out / "seed-0", BEHAVIORS / name / "expert")
    print(name, f"{summary.mean_return:.1f}", "without", sorted(reached), flush=True)


def write_behavior(policy: Path, out: Path) -> None:
    """Copy a policy with weights of 16 bits."""
    out.mkdir(parents=True, exist_ok=True)
    shutil.copy(policy / "policy.json", out)
    weights = load_file(policy / "policy.safetensors")
    halves = {
        key: value if key.startswith("observation.") else value.astype(np.float16)
        for key, value in weights.items()
    }
    save_file(halves, out / "policy.safetensors", {"description": "{}"})


def main() -> None:
    """Train the behaviors of the given tasks."""
    parser = argparse.ArgumentParser()
    parser.add_argument("tasks", nargs="+", choices=[t for t, task in TASKS.items() if task.online])
    parser.add_argument("--folder", type=Path, default=Path(".venv/suite"))
    arguments = parser.parse_args()
    for name in arguments.tasks:
        train_behaviors(name, arguments.folder)


if __name__ == "__main__":
    main()
