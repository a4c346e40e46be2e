"""Episodes of a policy in an environment or a vector environment."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from statistics import NormalDist
from types import MappingProxyType
from typing import Any, Final

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from mcaprl.actions import allowed_actions, joint_actions, masked
from mcaprl.base_policy import Actor, BasePolicy, RandomPolicy, as_policy
from mcaprl.errors import PolicyError, UsageError
from mcaprl.frames import mapped
from mcaprl.limits import STEP_LIMIT
from mcaprl.sims import make_sim, make_sims

Floats = NDArray[np.float64]
_QUANTILE = np.vectorize(NormalDist().inv_cdf, otypes=[np.float64])
_ERF = np.vectorize(math.erf, otypes=[np.float64])
_SMALLEST = 1e-6  # Smallest standard deviation of an episode, as a fraction of `noise`


class NoisyPolicy(BasePolicy):
    """Policy that adds Gaussian noise to the command of a deterministic policy.

    Each part of an action has the normal distribution around the command, truncated to the bounds
    of the action space. Clipped noise would have a positive probability of the bounds themselves,
    hence no density there. A command at a bound leaves half of the distribution. The random numbers
    of an episode depend only on the seed of `seed`.
    """

    is_deterministic = False

    def __init__(
        self,
        policy: BasePolicy,
        noise: float,
        action_space: spaces.Space[Any],
        *,
        per_episode: bool = False,
    ) -> None:
        """Add noise of the deviation `noise`, as a fraction of half the range of each part."""
        # Or of one drawn uniformly between 0 and `noise` for each episode.
        if not policy.is_deterministic or isinstance(policy, RandomPolicy):
            raise UsageError(
                f"`noise=` is added to the commands of a deterministic policy, not of {policy.name}"
            )
        if not (isinstance(action_space, spaces.Box) and action_space.dtype.kind == "f"):
            raise UsageError(
                f"`noise=` needs a Box of floats, not {action_space}: use `epsilon=`, or continuous"
                " actions"
            )
        if not action_space.is_bounded():
            raise UsageError(f"`noise=` needs finite bounds, not {action_space}")
        self.name = noisy_name(policy.name, noise, per_episode=per_episode)
        self.action_space, self.mask_from = action_space, policy.mask_from
        self.observation_space = policy.observation_space
        self._policy, self._noise, self._per_episode = policy, noise, per_episode
        self._low, self._high = (
            bound.astype(np.float64) for bound in (action_space.low, action_space.high)
        )
        self._last: tuple[Any, Floats] | None = None
        self.seed(0)

    def seed(self, seed: int) -> None:
        """Seed the noise of the episodes that begin from now on."""
        self._random = np.random.default_rng([seed, 2])

    def begin(self) -> None:
        """Start an episode: reset the policy's memory and draw the standard deviation."""
        self._policy.begin()
        self._last = None
        share = max(self._random.random(), _SMALLEST) if self._per_episode else 1.0
        self._sigma = share * self._noise * (self._high - self._low) / 2

    def act(self, observations: Any) -> NDArray[Any]:
        """Return noisy actions (B, *shape)."""
        mean = self._means(observations)
        drawn = quantile(self._random.random(mean.shape), mean, self._sigma, *self._bounds)
        assert self.action_space is not None
        actions: NDArray[Any] = drawn.astype(self.action_space.dtype)
        return actions

    def log_prob(self, observations: Any, actions: NDArray[Any]) -> Floats:
        """Return log densities (B,) for the episode's deviation; observations of `act` run once."""
        last = self._last
        is_last = last is not None and last[0] is observations
        mean = last[1] if last is not None and is_last else self._means(observations)
        found = log_density(np.asarray(actions, np.float64), mean, self._sigma, *self._bounds)
        total: Floats = found.reshape(len(found), -1).sum(1)
        return total

    @property
    def _bounds(self) -> tuple[Floats, Floats]:
        return self._low, self._high

    def _means(self, observations: Any) -> Floats:
        """Return the commands (B, *shape), and store them for `log_prob`."""
        commands = np.asarray(self._policy.act(observations), np.float64)
        mean: Floats = np.clip(commands, *self._bounds)
        self._last = observations, mean
        return mean


def quantile(
    share: Floats, mean: Floats, sigma: Floats | float, low: Floats | float, high: Floats | float
) -> Floats:
    """Return the quantiles of normal distributions truncated to [low, high]."""
    first, last = (_probability((bound - mean) / sigma) for bound in (low, high))
    shares = np.clip(first + (last - first) * share, 1e-16, 1 - 1e-16)
    found: Floats = np.clip(mean + sigma * _QUANTILE(shares), low, high)
    return found


def log_density(
    actions: Floats, mean: Floats, sigma: Floats | float, low: Floats | float, high: Floats | float
) -> Floats:
    """Return the log densities of numbers under normal distributions truncated to [low, high].

    The density is phi(z) / (sigma (Phi(b) - Phi(a))), where z, a and b are the standardized number
    and bounds. A number outside of the bounds has the log density -inf.
    """
    z = (actions - mean) / sigma
    inside = _probability((high - mean) / sigma) - _probability((low - mean) / sigma)
    found = -0.5 * z * z - np.log(math.sqrt(2 * math.pi) * sigma * inside)
    return np.where((actions >= low) & (actions <= high), found, -np.inf)


def _probability(z: Floats) -> Floats:
    """Return the normal distribution function Phi(z)."""
    found: Floats = 0.5 * (1.0 + _ERF(z / math.sqrt(2.0)))
    return found


def noisy_name(policy: str, noise: float, *, per_episode: bool) -> str:
    """Return the name of a policy with noise.

    >>> noisy_name("pilot", 0.1, per_episode=True), noisy_name("pilot", 0.0, per_episode=False)
    ('pilot, noise 0 to 0.1', 'pilot')
    """
    return f"{policy}, noise {'0 to ' if per_episode else ''}{noise:g}" if noise else policy


DEFAULT_MAX_STEPS: Final = 27_000
"""Limit in environments without a time limit: half an hour of an Atari game, as in ALE's papers."""


class StepLimit(gym.Wrapper[Any, Any, Any, Any]):
    """Wrapper that truncates episodes after `max_steps` steps, with the reason `step_limit`."""

    def __init__(self, env: gym.Env[Any, Any], max_steps: int) -> None:
        """Wrap `env`."""
        super().__init__(env)
        self.max_steps = max_steps  # Steps after which an episode is truncated
        self._step = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._step = 0
        return self.env.reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment, and truncate the episode if it has reached the limit."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._step += 1
        if self._step >= self.max_steps and not (terminated or truncated):
            truncated, info = True, {**info, "reason": STEP_LIMIT}
        return observation, reward, terminated, truncated, info


class _Borrowed(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper of a caller's environment, which leaves it open."""

    def close(self) -> None:
        """Do nothing."""


def make_or_borrow(name: str | gym.Env[Any, Any], /, **kwargs: Any) -> gym.Env[Any, Any]:
    """Make a sim as `make_sim` does, or wrap an environment so that `close` leaves it open."""
    return make_sim(name, **kwargs) if isinstance(name, str) else _Borrowed(name)


def make_limited(
    name: str | gym.Env[Any, Any], max_steps: int | None, /, **kwargs: Any
) -> gym.Env[Any, Any]:
    """Make an environment whose episodes end."""
    env = make_or_borrow(name, **kwargs)
    if max_steps is None and not _has_time_limit(env):
        max_steps = DEFAULT_MAX_STEPS
    return env if max_steps is None else StepLimit(env, max_steps)


def make_limited_sims(
    name: str, num_envs: int, max_steps: int | None, /, **kwargs: Any
) -> gym.vector.VectorEnv[Any, Any, Any]:
    """Make environments whose episodes end, which are stepped together; see `make_limited`."""
    # With another limit than that of the environment, they are stepped one after the other.
    limit = max_steps or _default_of(name, kwargs)
    if limit is None:
        return make_sims(name, num_envs, **kwargs)
    return make_sims(name, num_envs, wrappers=[partial(StepLimit, max_steps=limit)], **kwargs)


def warn_of_cuts(results: Iterable[EpisodeResult], policy: str, sim: str) -> None:
    """Warn if episodes reached the limit on their steps."""
    cut, count = [], 0
    for result in results:
        count += 1
        if result.reason == STEP_LIMIT:
            cut.append(result.length)
    if cut:
        warnings.warn(
            f"{policy}: {len(cut)} of {count} episodes in {sim} reached the limit of {max(cut)}"
            f" steps and were truncated ({STEP_LIMIT}); set another limit with `max_steps=N`",
            stacklevel=3,
        )


def _default_of(name: str, kwargs: dict[str, Any]) -> int | None:
    """Return the default limit on steps; None if the environment has a time limit itself."""
    options = {key: value for key, value in kwargs.items() if key != "autoreset_mode"}
    env = make_limited(name, None, **options)
    env.close()
    return env.max_steps if isinstance(env, StepLimit) else None


def _has_time_limit(env: gym.Env[Any, Any]) -> bool:
    if env.spec is not None and env.spec.max_episode_steps is not None:
        return True
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.wrappers.TimeLimit):
            return True
        env = env.env
    return False


MOST_NUMBERED = 1 << 62  # Largest number of actions that a policy chooses among by their numbers


@dataclass(frozen=True)
class EpisodeResult:
    """Result of one episode.

    Attributes:
        seed: Seed of the reset.
        total_reward: Undiscounted return.
        length: Number of transitions.
        reason: Reason why the episode ended; `interrupted` if the maximum number of steps was
            reached.
        positions: (length + 1, 2) x and y, meters; (0, 2) if the environment does not report them.
        command_change: Mean absolute change of the numbers of a Box action from step to step, in
            their units; NaN for other actions, and for episodes of one step.
    """

    seed: int
    total_reward: float
    length: int
    reason: str
    positions: NDArray[np.float64] = field(repr=False)
    command_change: float = math.nan


class EpsilonGreedy:
    """Epsilon-greedy exploration around a policy, with the probabilities of its actions."""

    def __init__(
        self,
        policy: Actor | None,
        epsilon: float,
        action_space: spaces.Space[Any],
        mask_from: str = "",
    ) -> None:
        """Follow `policy` (None: random), but act at random with probability `epsilon`."""
        is_random = policy is None or isinstance(policy, RandomPolicy)
        self.policy = None if is_random else as_policy(policy)
        self.epsilon = epsilon if self.policy else 1.0
        self.name = self.policy.name if self.policy else "random"
        self._space = action_space
        self._joint = joint_actions(action_space)
        self._random_policy = RandomPolicy(action_space)
        self.mask_from = self.policy.mask_from if self.policy else mask_from
        self.begin(0)

    def begin(self, seed: int) -> None:
        """Start an episode: reset the policy's memory and seed the exploration."""
        if isinstance(self.policy, NoisyPolicy):
            self.policy.seed(seed)
        if self.policy is not None:
            self.policy.begin()
        self._random = np.random.default_rng([seed, 1])
        self._space.seed(seed)

    def choose(
        self, observation: Any, info: Mapping[str, Any] = MappingProxyType({})
    ) -> tuple[Any, float]:
        """Return the action for one observation and its info, and what a log stores about it.

        That is the probability of the action, or the log density of an action of floats. Each of
        the A allowed actions has the probability epsilon / A; the policy's greedy action has an
        additional 1 - epsilon. Without an action mask, all actions are allowed. Each combination of
        the elements of a MultiDiscrete or MultiBinary space is one action; with more than
        `MOST_NUMBERED` actions, and for Boxes of integers, the probability is NaN. The log density
        is NaN if the policy is deterministic or has no densities, or if random actions are not
        uniform because a bound is infinite.
        """
        if self.mask_from:
            observation = masked(observation, info, self.mask_from)
        batch = mapped(lambda part: np.asarray(part)[None], observation)
        greedy: Any = None if self.policy is None else self.policy.act(batch)[0]
        explores = self.epsilon > 0 and self._random.random() < self.epsilon
        joint = self._joint
        if joint is None or joint.count > MOST_NUMBERED:
            action = self._space.sample() if explores else greedy
            return action, self._log_density(batch, np.asarray(action)[None])
        mask = allowed_actions(observation)
        # For MultiDiscrete spaces, there are also masks with one flag for each value of an element.
        if joint.shape and mask is not None and mask.shape != (joint.count,):
            mask = None
        allowed = range(joint.count) if mask is None else np.flatnonzero(mask).tolist()
        own = None if greedy is None else int(joint.indexes(np.asarray(greedy)[None])[0])
        if explores or own is None:
            number = allowed[int(self._random.integers(len(allowed)))]
            action = joint.values(np.array([number]))[0]
        else:
            number, action = own, greedy
        by_chance = self.epsilon / len(allowed) if number in allowed else 0.0
        chance = by_chance + (1 - self.epsilon) * (number == own)
        if self.policy is not None and not self.policy.is_deterministic:
            chance = math.nan
        return (action if joint.shape else int(action)), chance

    def _log_density(self, batch: Any, actions: NDArray[Any]) -> float:
        """Return the log density of an action (1, *shape); NaN if unknown."""
        is_box = isinstance(self._space, spaces.Box)
        if not is_box or (self.policy is not None and self.policy.is_deterministic):
            return math.nan
        parts = [(self.epsilon, self._random_policy), (1 - self.epsilon, self.policy)]
        try:
            found = [
                math.log(share) + float(policy.log_prob(batch, actions)[0])
                for share, policy in parts
                if share > 0 and policy is not None
            ]
        except PolicyError:
            return math.nan
        log_density = float(np.logaddexp.reduce(found))
        return log_density if math.isfinite(log_density) else math.nan


def episode_seed(seed: int, episode: int) -> int:
    """Return the seed of an episode; it depends only on the base seed and the episode's number."""
    return int(np.random.SeedSequence([seed, episode]).generate_state(1)[0])


def run_episode(
    env: gym.Env[Any, Any],
    behavior: EpsilonGreedy,
    *,
    seed: int,
    max_steps: int | None = None,
    on_action: Callable[[float], None] | None = None,
) -> EpisodeResult:
    """Run one episode to its end."""
    observation, info = env.reset(seed=seed)
    behavior.begin(seed)
    telemetry = getattr(env.unwrapped, "telemetry", None)
    positions = [_position(telemetry)]
    changes = _Changes(env.action_space, 1)
    total, length, reason = 0.0, 0, "interrupted"
    while max_steps is None or length < max_steps:
        action, probability = behavior.choose(observation, info)
        if on_action is not None:
            on_action(probability)
        changes.add(np.asarray(action)[None])
        observation, reward, terminated, truncated, info = env.step(action)
        positions.append(_position(telemetry))
        total += float(reward.item() if isinstance(reward, np.ndarray) else reward)
        length += 1
        if terminated or truncated:
            reason = str(info.get("reason") or ("terminated" if terminated else "time_limit"))
            break
    known = np.array([position for position in positions if position is not None])
    return EpisodeResult(seed, total, length, reason, known.reshape(-1, 2), changes.mean(0))


class _Changes:
    """Sums of the absolute changes of commands in several environments."""

    def __init__(self, space: spaces.Space[Any], envs: int) -> None:
        self._is_box = isinstance(space, spaces.Box)
        self._last: NDArray[np.float64] | None = None
        self._sums, self._steps = np.zeros(envs), 0

    def add(self, actions: NDArray[Any]) -> None:
        """Add the actions (E, *shape) of a step."""
        if not self._is_box:
            return
        now = np.asarray(actions, np.float64).reshape(len(actions), -1)
        if self._last is not None:
            self._sums += np.abs(now - self._last).mean(1)
            self._steps += 1
        self._last = now

    def mean(self, env: int) -> float:
        """Return the mean change in an environment so far."""
        return float(self._sums[env] / self._steps) if self._steps else math.nan


def rollout(
    env: gym.Env[Any, Any],
    behavior: EpsilonGreedy,
    *,
    seed: int,
    episodes: int | None = None,
    steps: int | None = None,
    first_episode: int = 0,
    on_action: Callable[[float], None] | None = None,
    on_episode: Callable[[EpisodeResult], None] | None = None,
) -> list[EpisodeResult]:
    """Run a number of episodes, or a number of steps.

    In an environment without a time limit, an episode may never end: add one with
    `gymnasium.wrappers.TimeLimit`.

    Args:
        env: Environment.
        behavior: Exploration policy.
        seed: Base seed; episode k is reset with `episode_seed(seed, k)`.
        episodes: Number of episodes, or None to count steps.
        steps: Total number of steps; the last episode may be interrupted.
        first_episode: Index k of the first episode.
        on_action: Function called before each step with what `EpsilonGreedy.choose` returns beside
            the action.
        on_episode: Function called after each episode.

    Raises:
        ValueError: Neither or both of `episodes` and `steps` are given.
    """
    if (episodes is None) == (steps is None):
        raise ValueError("pass either episodes or steps")
    results: list[EpisodeResult] = []
    done = 0
    while (episodes is not None and len(results) < episodes) or (
        steps is not None and done < steps
    ):
        result = run_episode(
            env,
            behavior,
            seed=episode_seed(seed, first_episode + len(results)),
            max_steps=None if steps is None else steps - done,
            on_action=on_action,
        )
        results.append(result)
        done += result.length
        if on_episode is not None:
            on_episode(result)
    return results


def batch_rollout(
    envs: gym.vector.VectorEnv[Any, Any, Any],
    policy: Actor,
    seeds: Sequence[int],
    on_episode: Callable[[EpisodeResult], None] | None = None,
) -> list[EpisodeResult]:
    """Run one greedy episode for each seed in parallel, with the same results as `run_episode`."""
    # Further episodes that start in an environment until the last one ends are ignored.
    assert envs.num_envs == len(seeds)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    # The base class is typed for a single seed, but vector environments accept a list.
    all_seeds: Any = list(seeds)
    observations, infos = envs.reset(seed=all_seeds)
    results: list[EpisodeResult | None] = [None] * len(seeds)
    running = np.ones(len(seeds), dtype=np.bool_)
    totals, length = np.zeros(len(seeds)), 0
    places = [_places(envs)]
    changes = _Changes(envs.single_action_space, len(seeds))
    while running.any():
        actions = policy.act(observations)
        changes.add(actions)
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        totals[running] += rewards[running]
        length += 1
        places.append(_places(envs))
        for i in np.flatnonzero(running & (terminated | truncated)).tolist():
            reason = _reason(infos, i) or ("terminated" if terminated[i] else "time_limit")
            path = np.array([place[i] for place in places if place is not None])
            result = EpisodeResult(
                seeds[i], float(totals[i]), length, reason, path.reshape(-1, 2), changes.mean(i)
            )
            results[i] = result
            if on_episode is not None:
                on_episode(result)
        running &= ~(terminated | truncated)
    return [result for result in results if result is not None]


def check_fit(
    policy: BasePolicy, env: gym.Env[Any, Any], observation_space: spaces.Space[Any] | None = None
) -> None:
    """Validate that the spaces of a trained policy and of an environment match; see `same_form`."""
    for role in ("observation_space", "action_space"):
        trained = getattr(policy, f"env_{role}", None) or getattr(policy, role, None)
        actual = getattr(env, role)
        if role == "observation_space" and observation_space is not None:
            actual = observation_space
        if trained is not None and not same_form(trained, actual):
            name = env.spec.id if env.spec else "the environment"
            others = _other_arguments(policy, env)
            hint = f"; the policy was trained with other arguments: pass `sim_options={others!r}`"
            raise PolicyError(
                f"{policy.name} was trained on {role} {trained}; {name} has"
                f" {actual}{hint if others else ''}"
            )


def _other_arguments(policy: BasePolicy, env: gym.Env[Any, Any]) -> dict[str, Any]:
    """Return the arguments of the training environment that differ from those of `env`."""
    own = env.spec.kwargs if env.spec else {}
    return {key: value for key, value in policy.env_kwargs.items() if own.get(key) != value}


def same_form(space: spaces.Space[Any], other: spaces.Space[Any]) -> bool:
    """Return whether values of two spaces have the same shapes and dtypes; bounds may differ.

    >>> same_form(spaces.Box(0, 1, (3,)), spaces.Box(-9, 9, (3,)))
    True
    """
    if isinstance(space, spaces.Dict) and isinstance(other, spaces.Dict):
        return space.keys() == other.keys() and all(
            same_form(space[key], other[key]) for key in space
        )
    if isinstance(space, spaces.Box) and isinstance(other, spaces.Box):
        return (space.shape, space.dtype) == (other.shape, other.dtype)
    return space == other


def _position(telemetry: Callable[[], dict[str, float]] | None) -> tuple[float, float] | None:
    values = telemetry() if telemetry is not None else {}
    return (values["x_m"], values["y_m"]) if "x_m" in values and "y_m" in values else None


def _places(envs: gym.vector.VectorEnv[Any, Any, Any]) -> NDArray[np.float64] | None:
    """Return (N, 2) x and y of all vehicles, meters; None if the sim does not report them."""
    places = getattr(envs.unwrapped, "places", None)
    return None if places is None else places()


def _reason(infos: dict[str, Any], i: int) -> str:
    reasons = infos.get("reason")
    return str(reasons[i]) if reasons is not None and infos["_reason"][i] else ""
