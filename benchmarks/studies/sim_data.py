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

These are the logs of FIRST. SECOND has other seeds, half as many transitions, and other behavior
policies of the same kinds, to test on new logs what was chosen on the first ones.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, NamedTuple, cast

import gymnasium as gym
import numpy as np

import mcaprl
from mcaprl.api import load_policies
from mcaprl.progress import TrainingProgress
from mcaprl.runs import read_curve
from mcaprl.sims import EpsilonGreedy, LaneKeepingEnv, Policy, make_pilot, make_sim, rollout

NAMES = ("random", "medium", "expert", "replay", "mixed", "weak")
WRONG = {"lane": "brake", "powerline": "no change", "racer": "none"}
"""Wrong action of the weak pilot, by sim."""
TIMID_ABOVE_M_S = {"lane": 5.0}
"""Minimum speed at which the weak pilot does the wrong thing, for the sims that have a minimum."""
MakeBehavior = Callable[[gym.Env[Any, Any]], EpsilonGreedy]


class LogSet(NamedTuple):
    """Parameters of the logs of a sim.

    Attributes:
        steps: Number of transitions of each log, before the last episode is finished.
        seed: Seed of the episodes and of the online trainings.
        medium_score: Score (random 0, pilot 1) of an evaluation during training at which the policy
            is medium.
        medium_returns: The same as mean returns, for the environments of Gymnasium.
        expert_epsilon: Probability of a random action in the expert log.
        medium_epsilon: The same in the medium log.
        mixed_epsilons: The same in each part of the mixed log.
        wrong: Probability of the wrong action in the weak log.
        clumsy: Probability of a random action in the weak log, at steps without the wrong one.
    """

    steps: int
    seed: int
    medium_score: float
    medium_returns: dict[str, float]
    expert_epsilon: float
    medium_epsilon: float
    mixed_epsilons: tuple[float, ...]
    wrong: float
    clumsy: float


FIRST: Final = LogSet(
    steps=20_000,
    seed=0,
    medium_score=0.5,
    medium_returns={"CartPole-v1": 200.0, "Acrobot-v1": -200.0},
    expert_epsilon=0.0,
    medium_epsilon=0.1,
    mixed_epsilons=(0.1, 0.3, 0.6, 1.0),
    wrong=0.6,
    clumsy=0.1,
)
SECOND: Final = LogSet(
    steps=10_000,
    seed=1,
    medium_score=0.75,
    medium_returns={"CartPole-v1": 300.0, "Acrobot-v1": -150.0},
    expert_epsilon=0.05,
    medium_epsilon=0.3,
    mixed_epsilons=(0.2, 0.5),
    wrong=0.4,
    clumsy=0.2,
)
# With seed 0, the untrained PPO policy of CartPole already returns 405.
GYM: Final[dict[str, dict[str, Any]]] = {
    "CartPole-v1": {"algo": "ppo", "seed": 1, "steps": 40_000},
    "Acrobot-v1": {
        "seed": 0,
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
}
"""Settings of the online training by Gymnasium id, for environments without a scripted pilot."""


class WeakPilot(EpsilonGreedy):
    """A pilot that does the wrong thing most of the time."""

    def __init__(self, env: gym.Env[Any, Any], sim: str, wrong: float, clumsy: float) -> None:
        """Wrap the pilot of `env`.

        Args:
            env: Environment of the sim.
            sim: Name of the sim.
            wrong: Probability of the wrong action.
            clumsy: Probability of a random action if the wrong one is not taken.
        """
        super().__init__(make_pilot(env), clumsy, env.action_space)
        self._probability, self._clumsy = wrong, clumsy
        meanings: tuple[str, ...] = env.get_wrapper_attr("action_meanings")
        self.name, self._wrong = "weak pilot", meanings.index(WRONG[sim])
        self._sim, self._timid_above_m_s = env.unwrapped, TIMID_ABOVE_M_S.get(sim)
        self._count = len(meanings)

    def choose(
        self, observation: Any, info: Mapping[str, Any] = MappingProxyType({})
    ) -> tuple[Any, float]:
        """Return the action for one observation, and its probability."""
        assert self.policy is not None
        weak = self._probability if self._is_weak_here() else 0.0
        chances = np.full(self._count, (1 - weak) * self._clumsy / self._count)
        chances[int(self.policy.act(observation[None])[0])] += (1 - weak) * (1 - self._clumsy)
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


def make_logs(folder: Path, sim: str, logs: LogSet = FIRST) -> dict[str, Path]:
    """Create the missing logs of a sim, and return the paths of all."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = {name: folder / f"{name}.mcap" for name in log_names(sim)}
    if sim in GYM and not (folder / "pilot").exists():
        shutil.rmtree(part := folder / "pilot.part", ignore_errors=True)
        mcaprl.train_online(sim, part, **_online_settings(sim, logs))
        part.rename(folder / "pilot")
    if not paths["replay"].exists():
        _learn_online(sim, folder / "online", paths["replay"], logs)
    for name, make_behaviors in _behaviors(sim, folder, logs).items():
        if not paths[name].exists():
            _record(paths[name], sim, make_behaviors, logs)
    return paths


def pilot_of(sim: str, folder: Path, env: gym.Env[Any, Any]) -> Policy:
    """Return the scripted pilot of a sim, or the policy that `make_logs` trained for GYM."""
    return load_policies(folder / "pilot")[0] if sim in GYM else make_pilot(env)


def _online_settings(sim: str, logs: LogSet) -> dict[str, Any]:
    given = GYM.get(sim, {"seed": 0})
    return {**given, "seed": given["seed"] + logs.seed, "eval_interval": 2_000}


def _learn_online(sim: str, out: Path, log: Path, logs: LogSet) -> None:
    """Train until the policy is medium; save the best policy in `out`."""

    def stop_early(now: TrainingProgress) -> None:
        if sim not in GYM:
            is_medium = now.terms["score"] >= logs.medium_score
        else:
            curves = [read_curve(curve) for curve in out.glob("seed-*/curve.csv")]
            least = logs.medium_returns[sim]
            is_medium = any((c["mean_return"] >= least).any() for c in curves)
        if is_medium:
            raise _MediumError

    shutil.rmtree(out, ignore_errors=True)
    part = log.with_suffix(".part.mcap")
    part.unlink(missing_ok=True)
    with contextlib.suppress(_MediumError):
        mcaprl.train_online(
            sim, out, record=part, progress=stop_early, **_online_settings(sim, logs)
        )
    part.rename(log)


class _MediumError(Exception):
    """Exception that stops an online training."""


def _behaviors(sim: str, folder: Path, logs: LogSet) -> dict[str, list[MakeBehavior]]:
    """Return the behavior policies of each log, in the order in which they are recorded."""

    def pilot(epsilon: float) -> MakeBehavior:
        return lambda env: EpsilonGreedy(pilot_of(sim, folder, env), epsilon, env.action_space)

    def medium(env: gym.Env[Any, Any]) -> EpsilonGreedy:
        policy = load_policies(folder / "online")[0]
        return EpsilonGreedy(policy, logs.medium_epsilon, env.action_space)

    def weak(env: gym.Env[Any, Any]) -> EpsilonGreedy:
        return WeakPilot(env, sim, logs.wrong, logs.clumsy)

    return {
        "random": [pilot(1.0)],
        "medium": [medium],
        "expert": [pilot(logs.expert_epsilon)],
        "mixed": [pilot(epsilon) for epsilon in logs.mixed_epsilons],
        **({"weak": [weak]} if sim in WRONG else {}),
    }


def _record(path: Path, sim: str, make_behaviors: list[MakeBehavior], logs: LogSet) -> None:
    """Record whole episodes. Each behavior policy makes an equal share of the transitions."""
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
            while done < logs.steps // len(make_behaviors):
                (episode,) = rollout(
                    recorder,
                    behavior,
                    seed=NAMES.index(path.stem) + len(NAMES) * logs.seed,
                    episodes=1,
                    first_episode=recorder.episodes,
                    on_action=tell_probability,
                )
                done += episode.length
    part.rename(path)
