"""Create six logs of each sim, of about 20,000 transitions each, for offline training.

random   random actions
medium   an online policy that scores half as much as the pilot, with 10 % random actions
expert   the sim's pilot
replay   all transitions of the medium policy's online training
mixed    in equal parts: the pilot with 10, 30 and 60 % random actions, and random actions
weak     a pilot that mostly does the wrong thing: drone and racer do nothing, the car brakes
         above 5 m/s

In most states, most actions of the weak pilot are bad, so a policy that imitates it is also bad.
The better actions are in the log, and its rewards identify them. A car that does nothing would
leave its lane within eight seconds, and its log would show little of the course.

CartPole and Acrobot have the same logs except the weak one. Their pilot is the best policy of an
online training, with PPO for CartPole and Double DQN for Acrobot. The medium policy is one of an
earlier stage of that training.
All logs have the probabilities of their actions.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Final, NamedTuple, cast

import gymnasium as gym
import numpy as np

import mcaprl
from mcaprl.api import load_policies
from mcaprl.progress import TrainingProgress
from mcaprl.runs import read_curve
from mcaprl.sims import EpsilonGreedy, LaneKeepingEnv, Policy, make_pilot, make_sim, rollout

STEPS = 20_000
NAMES = ("random", "medium", "expert", "replay", "mixed", "weak")
MEDIUM_SCORE = 0.5
"""Score (random 0, pilot 1) of an evaluation during training at which the training stops."""
WRONG = {"lane": "brake", "powerline": "no change", "racer": "none"}
"""Wrong action of the weak pilot, by sim."""
TIMID_ABOVE_M_S = {"lane": 5.0}
"""Minimum speed at which the weak pilot does the wrong thing, for the sims that have a minimum."""
WEAK, CLUMSY = 0.6, 0.1
"""Probability of the wrong action, and probability of a random action in the other cases."""
MIXED_EPSILONS = (0.1, 0.3, 0.6, 1.0)
MakeBehavior = Callable[[gym.Env[Any, Any]], EpsilonGreedy]


class GymTask(NamedTuple):
    """Environment of Gymnasium without a scripted pilot.

    Attributes:
        medium_return: Mean return of an evaluation at which the policy is medium.
        settings: Settings of the online training.
    """

    medium_return: float
    settings: dict[str, Any]


# With seed 0, the untrained policy of CartPole already returns 405.
GYM: Final = {
    "CartPole-v1": GymTask(200.0, {"algo": "ppo", "seed": 1, "steps": 40_000}),
    "Acrobot-v1": GymTask(
        -200.0,
        {
            "hidden": (128, 128),
            "learning_rate": 1e-3,
            "final_learning_rate_fraction": 0.04,
            "batch_size": 64,
            "learning_starts": 1_000,
            "steps_per_update": 1,
            "target_update_interval": 500,
            "exploration_fraction": 0.2,
            "buffer_size": 50_000,
            "steps": 40_000,
        },
    ),
}
"""Environments by Gymnasium id."""


class WeakPilot(EpsilonGreedy):
    """A pilot that does the wrong thing most of the time."""

    def __init__(self, env: gym.Env[Any, Any], sim: str) -> None:
        """Wrap the pilot of `env`, and set CLUMSY as the probability of a random action."""
        super().__init__(make_pilot(env), CLUMSY, env.action_space)
        meanings: tuple[str, ...] = env.get_wrapper_attr("action_meanings")
        self.name, self._wrong = "weak pilot", meanings.index(WRONG[sim])
        self._sim, self._timid_above_m_s = env.unwrapped, TIMID_ABOVE_M_S.get(sim)

    def choose(self, observation: Any) -> tuple[Any, float]:
        """Return the action for one observation, and its probability."""
        assert self.policy is not None
        weak = WEAK if self._is_weak_here() else 0.0
        chances = np.full(self._count, (1 - weak) * CLUMSY / self._count)
        chances[int(self.policy.act(observation[None])[0])] += (1 - weak) * (1 - CLUMSY)
        chances[self._wrong] += weak
        action = int(self._random.choice(self._count, p=chances))
        return action, float(chances[action])

    def _is_weak_here(self) -> bool:
        if self._timid_above_m_s is None:
            return True
        return cast(LaneKeepingEnv, self._sim).car.speed_m_s > self._timid_above_m_s


def log_names(sim: str) -> list[str]:
    """Return the names of the logs of a sim."""
    return [name for name in NAMES if name != "weak" or sim in WRONG]


def make_logs(folder: Path, sim: str) -> dict[str, Path]:
    """Create the missing logs of a sim, and return the paths of all."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = {name: folder / f"{name}.mcap" for name in log_names(sim)}
    if sim in GYM and not (folder / "pilot").exists():
        shutil.rmtree(part := folder / "pilot.part", ignore_errors=True)
        mcaprl.train_online(sim, part, **GYM[sim].settings, eval_interval=2_000)
        part.rename(folder / "pilot")
    if not paths["replay"].exists():
        _learn_online(sim, folder / "online", paths["replay"])
    for name, make_behaviors in _behaviors(sim, folder).items():
        if not paths[name].exists():
            _record(paths[name], sim, make_behaviors)
    return paths


def pilot_of(sim: str, folder: Path, env: gym.Env[Any, Any]) -> Policy:
    """Return the scripted pilot of a sim, or the policy that `make_logs` trained for GYM."""
    return load_policies(folder / "pilot")[0] if sim in GYM else make_pilot(env)


def _learn_online(sim: str, out: Path, log: Path) -> None:
    """Train until the policy is medium; save the best policy in `out`."""

    def stop_halfway(now: TrainingProgress) -> None:
        if sim not in GYM:
            is_medium = now.terms["score"] >= MEDIUM_SCORE
        else:
            curves = [read_curve(curve) for curve in out.glob("seed-*/curve.csv")]
            is_medium = any((c["mean_return"] >= GYM[sim].medium_return).any() for c in curves)
        if is_medium:
            raise _HalfwayError

    shutil.rmtree(out, ignore_errors=True)
    part = log.with_suffix(".part.mcap")
    part.unlink(missing_ok=True)
    with contextlib.suppress(_HalfwayError):
        settings = GYM[sim].settings if sim in GYM else {}
        mcaprl.train_online(
            sim, out, record=part, progress=stop_halfway, eval_interval=2_000, **settings
        )
    part.rename(log)


class _HalfwayError(Exception):
    """Exception that stops an online training."""


def _behaviors(sim: str, folder: Path) -> dict[str, list[MakeBehavior]]:
    """Return the behavior policies of each log, in the order in which they are recorded."""

    def pilot(epsilon: float) -> MakeBehavior:
        return lambda env: EpsilonGreedy(pilot_of(sim, folder, env), epsilon, env.action_space)

    def medium(env: gym.Env[Any, Any]) -> EpsilonGreedy:
        return EpsilonGreedy(load_policies(folder / "online")[0], 0.1, env.action_space)

    def weak(env: gym.Env[Any, Any]) -> EpsilonGreedy:
        return WeakPilot(env, sim)

    return {
        "random": [pilot(1.0)],
        "medium": [medium],
        "expert": [pilot(0.0)],
        "mixed": [pilot(epsilon) for epsilon in MIXED_EPSILONS],
        **({"weak": [weak]} if sim in WRONG else {}),
    }


def _record(path: Path, sim: str, make_behaviors: list[MakeBehavior]) -> None:
    """Record whole episodes. Each behavior policy makes an equal share of STEPS."""
    part = path.with_suffix(".part.mcap")
    with (
        closing(make_sim(sim)) as env,
        closing(
            mcaprl.RecordMcap(env, part, policy=path.stem, scene=False, overwrite=True)
        ) as recorder,
    ):

        def tell_probability(probability: float) -> None:
            recorder.behavior_prob = probability

        for make_behavior in make_behaviors:
            behavior, done = make_behavior(env), 0
            while done < STEPS // len(make_behaviors):
                (episode,) = rollout(
                    recorder,
                    behavior,
                    seed=NAMES.index(path.stem),
                    episodes=1,
                    first_episode=recorder.episodes,
                    on_action=tell_probability,
                )
                done += episode.length
    part.rename(path)
