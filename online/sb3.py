"""Adapter of Stable-Baselines3: its DQN, SAC, TD3, PPO and A2C, trained and saved as SB3 does.

TQC is that of sb3-contrib, an optional package.

SB3's own features extractors are used unless a setting asks for another encoder of images, for
dueling networks or for layer normalization. The models, their environments with SB3's interface,
and their checkpoints are all in this file; `online.zip_file` reads and writes SB3's files.
"""

from __future__ import annotations

import math
import random
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Final, cast

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
from torch import Tensor

from mcaprl.actions import BoxActions
from mcaprl.architecture import SMALL_EDGE, Architecture
from mcaprl.base_policy import BasePolicy
from mcaprl.errors import UsageError, import_extra
from mcaprl.frames import (
    FrameStack,
    is_image,
    joined,
    mapped,
    parts_of,
    parts_of_space,
    rows_of,
    stacked_space,
    whole_of,
)
from mcaprl.online.agent import Agent, center_images
from mcaprl.online.config import (
    ActorCriticConfig,
    DQNConfig,
    OnlineConfig,
    ReplayConfig,
    SACConfig,
    TD3Config,
    TQCConfig,
)
from mcaprl.online.features import (
    NetworkDQNPolicy,
    channels_first,
    inputs_of,
    normalize_images,
    policy_arguments,
)
from mcaprl.online.live import WATCHED, command_values, numbered_values
from mcaprl.online.zip_file import (
    ClampedGaussian,
    ModelEncoder,
    describe_run,
    policy_of,
    read_policy,
    save_policy,
)
from mcaprl.progress import ProgressCallback
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.runs import BEST_NAME
from mcaprl.sims.evaluation.rollout import episode_seed
from mcaprl.storage.tensor_files import below

MODELS: Final[dict[str, type[BaseAlgorithm]]] = {
    "dqn": DQN,
    "sac": SAC,
    "td3": TD3,
    "ppo": PPO,
    "a2c": A2C,
}


def model_type_of(algo: str) -> type[BaseAlgorithm]:
    """Return the class of an algorithm's models."""
    if algo == "tqc":
        found: type[BaseAlgorithm] = import_extra("sb3_contrib", "contrib").TQC
        return found
    return MODELS[algo]


_COUNTERS = (
    "num_timesteps",
    "_n_updates",
    "_episode_num",
    "_n_calls",
    "_current_progress_remaining",
    "exploration_rate",
)


class ModelAgent(Agent):
    """Agent of one seed, trained by a model of SB3."""

    best_files = (BEST_NAME,)
    repeats_steps = False

    def _prepare(self, tensors: dict[str, Tensor] | None) -> None:
        """Create a model with new weights."""
        task, config = self._task, self._task.config
        batched = BatchedVecEnv(self.env)
        batched.before_step = self._before_step
        stack = config.frame_stack
        env: VecEnv = batched if stack == 1 else StackedVecEnv(batched, stack)
        self.model = make_model(task.algo, config, env, self._seed)
        architecture = own_architecture(config, env.observation_space)
        space = self.env.single_observation_space
        if architecture is not None and config.center_images:
            encoder = ModelEncoder(space)
            center_images(encoder, task, self._seed)
            normalize_images(self.model.policy, encoder.image_inputs, config.frame_stack)
        self._description = describe_run(
            task.algo,
            config.hidden,
            space,
            self.env.single_action_space,
            self._env_id,
            task.sim_options,
            config.frame_stack,
            architecture,
        )
        self._row: dict[str, float] = {}
        self._actions: NDArray[Any] = np.zeros(0)
        self.model.set_logger(Logger(folder=None, output_formats=[_Rows(self._row)]))

    @property
    def steps(self) -> int:
        """Number of finished environment steps, summed over all environments."""
        return self.model.num_timesteps

    @cached_property
    def policy(self) -> BasePolicy:
        """Greedy policy, which shares the network of the model."""
        return policy_of(self.model.policy, self._description, self._task.algo)

    def best_policy(self) -> BasePolicy:
        """Read the policy with the best evaluation."""
        return read_policy(self._folder / BEST_NAME)

    def start_from(self, data: Dataset | None, policy: Any) -> None:
        """Refuse data and policies: only this package's learners start from them."""
        if data is not None or policy is not None:
            is_box = isinstance(self.env.single_action_space, spaces.Box)
            own = "`algo='sac'`, without `engine=`" if is_box else "`algo='double-dqn'`"
            raise UsageError(
                f"{self._task.algo} of Stable-Baselines3 cannot start from logs or a policy: train"
                f" with {own}"
            )

    def scalars(self) -> dict[str, float]:
        """Return the scalars that SB3 logs."""
        model: Any = self.model
        self._row.clear()
        model.dump_logs()
        return dict(self._row)

    def _train(self, report: ProgressCallback) -> None:
        """Train until all steps are done."""
        self.model.learn(
            self._task.config.steps - self.steps,
            callback=_Callbacks(self, report),
            log_interval=sys.maxsize,
            reset_num_timesteps=self.steps == 0,
        )
        self._save()

    def _before_step(self, actions: NDArray[Any]) -> None:
        """Pass what the log shows of a step."""
        self._actions = actions
        if self._recorder is not None:
            self._recorder.epsilon, self._recorder.policy_version = self.epsilon, self.updates
            found = behavior_of(self.model, actions)
            if isinstance(self.model.action_space, spaces.Box):
                self._recorder.behavior_log_probs = found
            else:
                self._recorder.behavior_probs = found

    def save_policy(self, folder: Path) -> None:
        """Write the current model into a folder, in the format of SB3."""
        save_policy(folder / BEST_NAME, self.model, self._description)

    def _state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return the state for a checkpoint, as tensors and as JSON values."""
        model, buffer = self.model, _buffer_of(self.model)
        tensors = {
            **{f"policy.{name}": value for name, value in model.policy.state_dict().items()},
            **_optimizer_tensors(model),
            **_temperature(model),
            **{f"buffer.{name}": torch.from_numpy(v) for name, v in _columns(model).items()},
        }
        counters = {name: getattr(model, name) for name in _COUNTERS if hasattr(model, name)}
        place = [] if buffer is None else [buffer.pos, buffer.full]
        states = _generators(model)
        return tensors, {"counters": counters, "place": place, "generators": states}

    def _load(self, tensors: dict[str, Tensor], description: dict[str, Any]) -> None:
        """Restore what `_state` returned. The environments start new episodes, with a new seed."""
        model, buffer = self.model, _buffer_of(self.model)
        model.policy.load_state_dict(below(tensors, "policy"))
        for name, optimizer in _optimizers(model).items():
            _load_optimizer(optimizer, below(tensors, name))
        for name, value in _temperature(model).items():
            value.copy_(tensors[name])
        if buffer is not None:
            buffer.pos, buffer.full = description["place"]
            content = below(tensors, "buffer")
            for name, rows in _columns(model).items():
                rows[:] = content[name].numpy()
        for name, value in description["counters"].items():
            setattr(model, name, value)
        _load_generators(model, description["generators"])
        assert model.env is not None
        model.env.seed(episode_seed(self._seed, self.steps))

    # What the live view shows.

    @property
    def epsilon(self) -> float:
        """Probability of a random action in this step; NaN if the policy is stochastic."""
        return exploration(self.model)

    @property
    def updates(self) -> int:
        """Number of updates of the network."""
        return int(cast(Any, self.model)._n_updates)

    def probability(self) -> float:
        """Return the probability, or log density, of the action of the watched environment."""
        return float(behavior_of(self.model, self._actions)[WATCHED])

    def values(self, taken: NDArray[Any]) -> dict[str, Any]:
        """Return the fields of `values_schema` for the watched action; unknown values for a Box."""
        model = self.model
        observation: Any = rows_of(model._last_obs, slice(WATCHED, WATCHED + 1))
        if isinstance(model.action_space, spaces.Box):
            command = model.predict(observation, deterministic=True)[0][0]
            log_prob = self.probability()
            return command_values(command, taken, model.action_space, log_prob=log_prob)
        tensor: Any = model.policy.obs_to_tensor(observation)[0]
        with torch.inference_mode():
            if isinstance(model, DQN):
                q = model.q_net(tensor)[0]
                return numbered_values(q, q.softmax(0), float(q.max()), int(taken))
            policy = cast(ActorCriticPolicy, model.policy)
            preference = cast(Any, policy.get_distribution(tensor).distribution).probs[0]
            value = float(policy.predict_values(tensor))
            unknown = torch.full_like(preference, torch.nan)
            return numbered_values(unknown, preference, value, int(taken))

    def metrics(self) -> dict[str, float]:
        """Return the metrics of `/rl/training`, without the score."""
        model = self.model
        logged = {**self._row, **model.logger.name_to_value}
        returns = [episode["r"] for episode in model.ep_info_buffer or ()]
        return {
            "mean_return": float(np.mean(returns)) if returns else math.nan,
            "loss": logged.get("train/loss", logged.get("train/value_loss", math.nan)),
            "epsilon": self.epsilon,
            "mean_q": math.nan,
            "learning_rate": next(iter(_optimizers(model).values())).param_groups[0]["lr"],
            "steps": self.steps,
            "updates": self.updates,
        }


class _Rows(KVWriter):
    """Output of SB3's logger that keeps the last value of each scalar."""

    def __init__(self, row: dict[str, float]) -> None:
        self._row = row

    def write(self, key_values: dict[str, Any], key_excluded: Any, step: int = 0) -> None:
        self._row.update({key: float(value) for key, value in key_values.items()})


class _Callbacks(BaseCallback):
    """Evaluations, reports and checkpoints of an agent."""

    def __init__(self, agent: ModelAgent, report: ProgressCallback) -> None:
        super().__init__()
        self._agent, self._report, self._saved_at = agent, report, agent.steps

    def _on_step(self) -> bool:
        before = self.num_timesteps - self._agent._task.config.envs
        self._agent._after_step(before, self._report)
        return True

    def _on_rollout_start(self) -> None:
        # Between rollouts, all steps have been processed.
        if self.num_timesteps - self._saved_at >= self._agent._task.config.checkpoint_interval:
            self._saved_at = self.num_timesteps
            self._agent._save()


def make_model(algo: str, config: OnlineConfig, env: VecEnv, seed: int) -> BaseAlgorithm:
    """Create a model with new weights, and seed Python, NumPy and torch."""
    model_type: Any = model_type_of(algo)
    _check(algo, config, env.observation_space)
    architecture = own_architecture(config, env.observation_space)
    policy_kwargs: dict[str, Any] = {"net_arch": list(config.hidden)}
    policy: Any = "CnnPolicy" if is_image(env.observation_space) else "MlpPolicy"
    if isinstance(env.observation_space, spaces.Dict):
        policy = "MultiInputPolicy"
    if architecture is not None:
        policy_kwargs = policy_arguments(architecture)
        if model_type is DQN:
            policy = NetworkDQNPolicy
    if model_type is not A2C:
        policy_kwargs["optimizer_kwargs"] = {"fused": True}
    box: dict[str, Any] = {}
    if isinstance(config, ActorCriticConfig):
        size = math.prod(env.action_space.shape or ())
        if isinstance(config, SACConfig):
            box = {"target_entropy": config.target_entropy * size}
        elif isinstance(config, TD3Config):
            noise = np.full(size, config.exploration_noise)
            box = {"action_noise": NormalActionNoise(np.zeros(size), noise)}
    last_rate = config.learning_rate * config.final_learning_rate_fraction
    model: BaseAlgorithm = model_type(
        policy,
        env,
        learning_rate=LinearSchedule(config.learning_rate, last_rate, 1.0),
        policy_kwargs=policy_kwargs,
        seed=seed,
        device="auto",
        **config.arguments(),
        **box,
    )
    encoder = "nature" if architecture is None else architecture.encoder
    if encoder == "nature" and _has_images(env.observation_space):
        # Convolutions take 25 % less time in channels-last format; results do not change.
        cast(Any, model.policy).to(memory_format=torch.channels_last)
    return model


def _check(algo: str, config: OnlineConfig, space: spaces.Space[Any]) -> None:
    """Refuse settings that SB3's algorithms with a replay buffer do not have."""
    if not isinstance(config, ReplayConfig):
        return
    lacks: tuple[str, ...] = ("image_shift", "exploration_decay", "target_update_episodes")
    lacks += ("critic_layer_norm", "smoothness")
    given = [name for name in lacks if getattr(config, name, False)]
    if config.n_steps > 1 and isinstance(space, spaces.Dict):
        given.append("n_steps for Dict observations")
    others = {DQNConfig: "use `algo='double-dqn'`", TQCConfig: "use `algo='sac'`"}
    own = others.get(type(config), "omit `engine='sb3'`")
    if given:
        raise UsageError(f"{algo} of Stable-Baselines3 has no {given[0]}: omit it, or {own}")
    if isinstance(config, ActorCriticConfig) and own_architecture(config, space) is not None:
        raise UsageError(
            f"{algo} of Stable-Baselines3 has its own networks only: pass `encoder='nature'`,"
            f" `center_images=False` and `layer_norm=False`, or {own}"
        )


def own_architecture(config: OnlineConfig, space: spaces.Space[Any]) -> Architecture | None:
    """Return the architecture of this package's network, or None to use SB3's own network."""
    images = inputs_of(channels_first(space))[1]
    architecture = config.architecture_for(image.shape[2] // config.frame_stack for image in images)
    adapts_images = images and (config.center_images or architecture.encoder != "nature")
    if (
        adapts_images
        or _has_small_images(space)
        or architecture != Architecture(config.hidden, encoder=architecture.encoder)
    ):
        return architecture
    return None


def _has_small_images(space: spaces.Space[Any]) -> bool:
    """Return whether SB3's own networks refuse images of the space."""
    parts = parts_of_space(channels_first(space)).values()
    return any(is_image(part) and min(part.shape[1:]) < SMALL_EDGE for part in parts)


def _has_images(space: spaces.Space[Any]) -> bool:
    return any(is_image(part) for part in parts_of_space(space).values())


def exploration(model: BaseAlgorithm) -> float:
    """Return epsilon of the next step; NaN if the policy is stochastic from the start."""
    if not isinstance(model, OffPolicyAlgorithm):
        return math.nan
    if model.num_timesteps < model.learning_starts:
        return 1.0
    return model.exploration_rate if isinstance(model, DQN) else 0.0


def behavior_of(model: BaseAlgorithm, actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return the values of `behavior_prob` or `behavior_log_prob` of actions (N, *shape)."""
    is_box = isinstance(model.action_space, spaces.Box)
    return (behavior_log_densities if is_box else behavior_probabilities)(model, actions)


def behavior_log_densities(model: BaseAlgorithm, actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return the log densities (N,) with which the model chose these actions of a Box."""
    # PPO, A2C and TD3 clip their normal distributions, so an action with a number at a bound has a
    # probability instead of a density: NaN.
    box = BoxActions.of(cast(spaces.Box, model.action_space))
    numbers = torch.from_numpy(box.scaled(actions)).double()
    if exploration(model) == 1.0:
        return np.full(len(actions), box.log_scale - box.size * math.log(2))
    policy: Any = model.policy
    with torch.inference_mode():
        observations = policy.obs_to_tensor(model._last_obs)[0]
        if hasattr(model, "log_ent_coef"):
            mean, log_std, _ = policy.actor.get_action_dist_params(observations)
            found = ClampedGaussian.log_density(torch.stack((mean, log_std), 1).cpu(), numbers)
            return found.numpy() + box.log_scale
        if isinstance(model, TD3):
            assert isinstance(model.action_noise, VectorizedActionNoise | NormalActionNoise)
            noise: Any = getattr(model.action_noise, "base_noise", model.action_noise)
            normal: Any = torch.distributions.Normal(
                policy.actor(observations).cpu().double(), torch.from_numpy(noise._sigma)
            )
            found = normal.log_prob(numbers).sum(1) + box.log_scale
        else:
            taken = torch.as_tensor(actions, device=policy.device)
            found = policy.get_distribution(observations).log_prob(taken).cpu()
    at_bound = (numbers.abs() >= 1).any(1)
    return cast("NDArray[np.float64]", found.double().masked_fill(at_bound, torch.nan).numpy())


def behavior_probabilities(model: BaseAlgorithm, actions: NDArray[Any]) -> NDArray[np.float64]:
    """Return the probabilities with which the model chose these actions of a finite space."""
    # With a Q-network, they are epsilon / A, plus 1 - epsilon for the greedy action. SB3 explores
    # either in all environments or in none; these are the marginal probabilities.
    policy = model.policy
    with torch.inference_mode():
        if isinstance(model, DQN):
            epsilon, count = exploration(model), int(cast(spaces.Discrete, model.action_space).n)
            if epsilon == 1.0:
                return np.full(len(actions), 1 / count)
            values = model.q_net(policy.obs_to_tensor(cast(Any, model._last_obs))[0])
            own: NDArray[np.bool_] = np.asarray(actions) == values.argmax(1).cpu().numpy()
            return np.asarray(epsilon / count + (1 - epsilon) * own)
        assert isinstance(policy, ActorCriticPolicy)
        observations = policy.obs_to_tensor(cast(Any, model._last_obs))[0]
        chosen = torch.as_tensor(actions, device=policy.device)
        logarithms = policy.get_distribution(observations).log_prob(chosen)
    return np.exp(logarithms.cpu().numpy().astype(np.float64))


def _buffer_of(model: BaseAlgorithm) -> Any:
    return model.replay_buffer if isinstance(model, OffPolicyAlgorithm) else None


def _columns(model: BaseAlgorithm) -> dict[str, NDArray[Any]]:
    """Return the filled rows of a replay buffer's arrays by name (`name.key` in a dict)."""
    buffer = _buffer_of(model)
    columns: dict[str, NDArray[Any]] = {}
    for name, value in ({} if buffer is None else vars(buffer)).items():
        parts = {f"{name}.{k}": v for k, v in value.items()} if isinstance(value, dict) else {}
        columns |= {k: v for k, v in {name: value, **parts}.items() if isinstance(v, np.ndarray)}
    return {name: column[: buffer.size()] for name, column in columns.items()}


def _optimizers(model: BaseAlgorithm) -> dict[str, torch.optim.Optimizer]:
    """Return the optimizers of a model by their names in checkpoints."""
    if not hasattr(model, "critic"):
        return {"optimizer": model.policy.optimizer}
    found = {f"optimizer_{name}": getattr(model, name).optimizer for name in ("actor", "critic")}
    temperature: torch.optim.Optimizer | None = getattr(model, "ent_coef_optimizer", None)
    return found if temperature is None else {**found, "optimizer_temperature": temperature}


def _temperature(model: BaseAlgorithm) -> dict[str, Tensor]:
    """Return the logarithm of the temperature of SAC and TQC, which is not a policy's weight."""
    found: Tensor | None = getattr(model, "log_ent_coef", None)
    return {} if found is None else {"log_temperature": found.detach()}


def _optimizer_tensors(model: BaseAlgorithm) -> dict[str, Tensor]:
    return {
        f"{key}.{index}.{name}": value
        for key, optimizer in _optimizers(model).items()
        for index, moments in optimizer.state_dict()["state"].items()
        for name, value in moments.items()
    }


def _load_optimizer(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    moments: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".")
        moments.setdefault(int(index), {})[name] = value
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    for number, parts in moments.items():
        for name, part in parts.items():
            if part.shape == weights[number].shape:
                # Optimizer moments need the same memory format as their weights, which is
                # channels-last for convolutions.
                parts[name] = torch.empty_like(weights[number]).copy_(part)
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": moments, "param_groups": groups})


def _generators(model: BaseAlgorithm) -> dict[str, Any]:
    """Return the states of the random generators as JSON values."""
    name, key, *others = np.random.get_state(legacy=True)  # noqa: NPY002
    return {
        "torch": torch.get_rng_state().tolist(),
        "numpy": [name, cast(Any, key).tolist(), *others],
        "python": random.getstate(),
        "actions": model.action_space.np_random.bit_generator.state,
    }


def _load_generators(model: BaseAlgorithm, states: Mapping[str, Any]) -> None:
    torch.set_rng_state(torch.tensor(states["torch"], dtype=torch.uint8))
    np.random.set_state(tuple(states["numpy"]))  # noqa: NPY002
    version, words, next_gauss = states["python"]
    random.setstate((version, tuple(words), next_gauss))
    model.action_space.np_random.bit_generator.state = states["actions"]


class BatchedVecEnv(VecEnv):
    """A `gymnasium.vector.VectorEnv` with SB3's interface."""

    # At an episode's end, `infos[i]` has what SB3 reads: `terminal_observation`,
    # `TimeLimit.truncated`, and `episode` as of SB3's `Monitor`; also `reason` and `progress_m` if
    # reported.

    def __init__(self, env: Any) -> None:
        """Adapt `env`. In the step that ends an episode, it must also reset that environment."""
        assert isinstance(env, VectorEnv)
        assert env.metadata.get("autoreset_mode") is AutoresetMode.SAME_STEP
        self.env: Any = env
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        # Callback that receives the actions (N,) before each step, if any.
        self.before_step: Callable[[NDArray[Any]], None] | None = None
        self._actions: NDArray[Any] = np.zeros(0)
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, dtype=np.int64)
        self._began_s = time.time()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next reset; the seed of environment i is `episode_seed(seed, i)`."""
        if seed is not None:
            self._seeds = [episode_seed(seed, i) for i in range(self.num_envs)]
        return self._seeds

    def reset(self) -> VecEnvObs:
        """Start new episodes in all environments."""
        observations, _ = self.env.reset(seed=None if self._seeds[0] is None else self._seeds)
        self._reset_seeds()
        self._returns[:] = 0.0
        self._lengths[:] = 0
        return cast(VecEnvObs, observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Store the actions for `step_wait`."""
        if self.before_step is not None:
            self.before_step(actions)
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Step all environments; those whose episode ends are reset in the same step."""
        observations, rewards, terminated, truncated, batch_info = self.env.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        dones = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(dones).tolist():
            infos[i] = self._end(i, batch_info, bool(truncated[i] and not terminated[i]))
        return cast(VecEnvObs, observations), rewards.astype(np.float32), dones, infos

    def _end(self, i: int, batch_info: dict[str, Any], timed_out: bool) -> dict[str, Any]:
        """Return SB3's info dict for the episode that has ended in environment i."""
        final_info = batch_info["final_info"]
        monitor = {
            "r": float(self._returns[i]),
            "l": int(self._lengths[i]),
            "t": time.time() - self._began_s,
        }
        self._returns[i], self._lengths[i] = 0.0, 0
        info = {
            "terminal_observation": batch_info["final_obs"][i],
            "TimeLimit.truncated": timed_out,
            "episode": monitor,
        }
        for key, kind in (("reason", str), ("progress_m", float)):
            if final_info.get(f"_{key}", np.zeros(self.num_envs, dtype=bool))[i]:
                info[key] = kind(final_info[key][i])
        return info

    def close(self) -> None:
        """Close the environments."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of the batch, repeated for each environment."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the batch. Its environments have no separate attributes."""
        setattr(self.env, attr_name, value)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the batch, once for all environments."""
        return [getattr(self.env, method_name)(*method_args, **method_kwargs)]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for each environment, because only the batch can be wrapped."""
        return [False] * len(list(self._get_indices(indices)))


class StackedVecEnv(VecEnvWrapper):
    """Wrapper whose observations are stacks of the last k observations."""

    def __init__(self, venv: VecEnv, count: int) -> None:
        """Stack `count` observations; `venv` must reset an environment when its episode ends."""
        self._frames = FrameStack(count)
        super().__init__(venv, stacked_space(venv.observation_space, count))

    def reset(self) -> VecEnvObs:
        """Start new episodes in all environments."""
        self._frames.clear()
        return self._joined(self._frames.see(parts_of(self.venv.reset())))

    def step_wait(self) -> VecEnvStepReturn:
        """Step all environments; stack the observations, and also each `terminal_observation`."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self._frames.see(parts_of(observations))
        for row in np.flatnonzero(dones).tolist():
            last = parts_of(infos[row]["terminal_observation"])
            stack = self._joined(self._frames.ending(row, last))
            infos[row]["terminal_observation"] = mapped(lambda part: part[0], stack)
            self._frames.begin_one(row)
        return self._joined(self._frames.frames), rewards, dones, infos

    def _joined(self, frames: dict[Any, NDArray[Any]]) -> VecEnvObs:
        return cast(VecEnvObs, joined(whole_of(frames), self.venv.observation_space))
