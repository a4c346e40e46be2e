"""Measure updates per second of Double DQN and CQL relative to d3rlpy's and SB3's DQN.

    python -m benchmarks.speed.learning [--rounds 7] [--turn-s 1.0] [--only images]
    python -m benchmarks.speed.learning --only gradients

All libraries take turns in one process, on the same random transitions (19 numbers, 9 actions) and
with layer widths 256x256. The measure is CPU time on one thread, the best of several turns. The
rows of images have observations of 84x84 bytes, batch size 32, and default settings otherwise. The
last row covers all steps from a log to a policy: a log of LOG_ROWS steps on disk is read and
packed, and CQL makes LOG_UPDATES updates with batch size 256. It is compared with reading by mcap
and mcap-ros2-support, and training by d3rlpy. These libraries load only a tenth of the log, and
the time to load it is multiplied by ten. The time of LOG_UPDATES updates is calculated from the
rates in the turns. The ratios are printed and written to benchmarks/speed/learning.json. The table
is written to docs/results.md. With --only 256, 32, images or whole, the other rows keep the values
of an earlier run.

--only gradients compares updates with autograd to the same updates with closed-form gradients,
which this file implements. It prints the ratios of the speeds, and runs neither d3rlpy nor SB3.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import DQN
from stable_baselines3.common.logger import configure
from torch.nn import functional

import mcaprl
from benchmarks.page import write_section
from benchmarks.speed import rivals
from benchmarks.speed.workloads import EPISODE_STEPS, vectors
from mcaprl.files import write_json
from mcaprl.offline import ALGORITHMS, DoubleDQN, Learner, TransitionBuffer

CHECKED_UPDATES = 10
ROWS, EPISODE, WIDTH, ACTIONS = 20_000, 1_000, 19, 9
LOG_ROWS, LOG_SHARE, LOG_UPDATES = 1_000_000, 0.1, 8_000
HIDDEN = [256, 256]
IMAGE_ROWS, IMAGE_EPISODE, IMAGE_SHAPE, IMAGE_BATCH = 2_000, 100, (84, 84), 32
RESULTS = Path(__file__).with_name("learning.json")
LIBRARIES = ("torch", "d3rlpy", "stable-baselines3", "mcap", "mcap-ros2-support")
DDQN, CQL, SB3 = "Double DQN / d3rlpy's", "CQL / d3rlpy's", "Double DQN / SB3's DQN"
SEEDS = "CQL, four seeds at once / one after the other"
IMAGES = "Double DQN / SB3's DQN, images, batch 32"
SAME_NETWORK = f"{IMAGES}, ours with SB3's network"
WHOLE = "from a log of a million steps to a CQL policy / mcap-ros2-support and d3rlpy"
GOALS = {
    f"{DDQN}, batch 256": 3.0,
    f"{CQL}, batch 256": 3.3,
    f"{SB3}, batch 256": 1.25,
    f"{DDQN}, batch 32": 3.0,
    f"{CQL}, batch 32": 3.8,
    f"{SB3}, batch 32": 2.0,
    IMAGES: 1.5,
    WHOLE: 4.0,
}
Update = Callable[[], object]


def transitions() -> mcaprl.Dataset:
    """Return random transitions in episodes of 1000."""
    random = np.random.default_rng(0)
    frames = random.normal(size=(ROWS // EPISODE, EPISODE + 1, WIDTH)).astype(np.float32)
    return _with_rest(frames, random)


def images() -> mcaprl.Dataset:
    """Return transitions with random images of one channel, in episodes of 100."""
    random = np.random.default_rng(0)
    shape = (IMAGE_ROWS // IMAGE_EPISODE, IMAGE_EPISODE + 1, *IMAGE_SHAPE, 1)
    return _with_rest(random.integers(256, size=shape, dtype=np.uint8), random)


def _with_rest(frames: NDArray[Any], random: np.random.Generator) -> mcaprl.Dataset:
    """Return transitions with the observations `frames` (episodes, steps + 1, ...)."""
    shape = frames.shape[2:]
    before, after = (part.reshape(-1, *shape) for part in (frames[:, :-1], frames[:, 1:]))
    rows, episode = len(before), frames.shape[1] - 1
    return mcaprl.Dataset.from_arrays(
        observations=before,
        next_observations=after,
        actions=random.integers(ACTIONS, size=rows),
        rewards=random.normal(size=rows),
        terminated=np.zeros(rows, bool),
        truncated=np.arange(1, rows + 1) % episode == 0,
        action_space=spaces.Discrete(ACTIONS),
    )


def ours(data: mcaprl.Dataset, algo: str, batch_size: int, seeds: int = 1) -> Update:
    """Return a function that makes one update of mcaprl's learner with `seeds` seeds."""
    return learner_of(data, algo, batch_size, seeds).update


def learner_of(
    data: mcaprl.Dataset, algo: str, batch_size: int, seeds: int = 1, **settings: Any
) -> Learner:
    """Return a learner with `seeds` seeds; all but the given settings have defaults."""
    config = ALGORITHMS[algo].config_type(batch_size=batch_size, **settings)
    buffer = TransitionBuffer.from_dataset(data, config.packing)
    return ALGORITHMS[algo](config, buffer, range(seeds))


def d3rlpys(data: Any, config: str, batch_size: int) -> Update:
    """Return a function that draws a batch from d3rlpy's buffer and makes one update."""
    import d3rlpy

    log = d3rlpy.dataset.MDPDataset(
        data.observations,
        data.actions,
        data.rewards.astype(np.float32),
        data.terminated.astype(np.float32),
        data.truncated.astype(np.float32),
        action_space=d3rlpy.ActionSpace.DISCRETE,
        action_size=ACTIONS,
    )
    encoder = d3rlpy.models.VectorEncoderFactory(HIDDEN)
    settings: dict[str, Any] = {"batch_size": batch_size, "encoder_factory": encoder}
    learner = getattr(d3rlpy.algos, config)(**settings, target_update_interval=500).create("cpu")
    learner.build_with_dataset(log)
    return lambda: learner.update(log.sample_transition_batch(batch_size))


def sb3s(data: mcaprl.Dataset, batch_size: int) -> Update:
    """Return a function that makes ten updates of SB3's DQN, which is not a Double DQN."""
    before, after = data.observations, data.next_observations
    if before.ndim > 2:
        # SB3's convolutions expect the channels first.
        before, after = (np.moveaxis(images, -1, 1) for images in (before, after))
        policy, space = "CnnPolicy", spaces.Box(0, 255, before.shape[1:], np.uint8)
    else:
        policy, space = "MlpPolicy", spaces.Box(-np.inf, np.inf, before.shape[1:], np.float32)

    class Spaces(gym.Env[Any, Any]):
        observation_space = space
        action_space = spaces.Discrete(ACTIONS)

    settings: dict[str, Any] = {"batch_size": batch_size, "buffer_size": len(data)}
    if policy == "MlpPolicy":
        settings["policy_kwargs"] = {"net_arch": HIDDEN}
    model = DQN(policy, Spaces(), device="cpu", **settings)
    model.set_logger(configure(None, []))
    assert model.replay_buffer is not None
    for observation, following, action, reward in zip(
        before, after, data.actions, data.rewards, strict=True
    ):
        model.replay_buffer.add(
            observation[None], following[None], action[None, None], reward[None], np.zeros(1), [{}]
        )
    return lambda: model.train(gradient_steps=10, batch_size=batch_size)


def closed_form(learner: Learner, alpha: float) -> Update:
    """Return a function that updates a learner with one seed, without autograd.

    The gradient of the loss with respect to Q(s, a) is clip(Q - target, -1, 1) for the action
    taken, plus alpha (softmax(Q) - onehot) for the penalty of CQL. The rest is the chain rule for
    linear layers and ReLU.

    Args:
        learner: Double DQN, for which `alpha` is 0, or CQL; with an MLP on vectors.
        alpha: Weight of the penalty.
    """
    assert isinstance(learner, DoubleDQN)
    config, model = learner.config, learner.models["q"]
    parameters = [parameter.detach() for parameter in model.networks[0].parameters()]
    sizes = [parameter.numel() for parameter in parameters]
    model.weights.grad = torch.zeros_like(model.weights)
    parts = model.weights.grad[0, : sum(sizes)].split(sizes)
    gradients = [part.view_as(own) for part, own in zip(parts, parameters, strict=True)]
    matrices, biases, d_matrices, d_biases = (
        tensors[first::2] for tensors in (parameters, gradients) for first in (0, 1)
    )

    @torch.no_grad()
    def update() -> None:
        rows = learner.buffer.sample_rows(config.batch_size, learner.samplers[0])
        batch = learner.buffer.batch(rows)
        actions = batch.actions.unsqueeze(1)
        target = learner.targets(batch, learner.target_outputs(batch))
        activations = [batch.observations.vector]
        for matrix, bias in zip(matrices[:-1], biases[:-1], strict=True):
            activations.append(functional.linear(activations[-1], matrix, bias).relu_())
        q = functional.linear(activations[-1], matrices[-1], biases[-1])
        value = q.gather(1, actions).squeeze(1)
        loss = functional.huber_loss(value, target, reduction="none")
        step = (value - target).clamp_(-1, 1)
        if alpha:
            loss += alpha * (q.logsumexp(1) - value)
            delta = q.softmax(1).mul_(alpha)
            step -= alpha
        else:
            delta = torch.zeros_like(q)
        assert math.isfinite(loss.sum().item())
        delta.scatter_add_(1, actions, step.unsqueeze(1)).div_(config.batch_size)
        for layer in reversed(range(len(matrices))):
            torch.mm(delta.T, activations[layer], out=d_matrices[layer])
            torch.sum(delta, 0, out=d_biases[layer])
            if layer:
                delta = (delta @ matrices[layer]).mul_(activations[layer] > 0)
        learner.optimizer.param_groups[0]["lr"] = config.learning_rate_at(learner.step)
        learner.optimizer.step()
        learner.step += 1
        if learner.step % config.target_interval == 0:
            learner.target_network.sync(model)

    return update


def gradient_rows(size: int, turns: Turns) -> dict[str, float]:
    """Return the speed of autograd relative to closed-form gradients at one batch size."""
    data = transitions()
    results = {}
    for algo, label in (("double-dqn", "Double DQN"), ("cql", "CQL")):
        alpha = float(getattr(ALGORITHMS[algo].config_type(), "alpha", 0.0))
        learners = [learner_of(data, algo, size) for _ in range(2)]
        by_autograd, by_hand = learners[0].update, closed_form(learners[1], alpha)
        for _ in range(CHECKED_UPDATES):
            by_autograd()
            by_hand()
        first, second = (learner.models["q"].weights.detach() for learner in learners)
        assert torch.allclose(first, second, atol=1e-4), "the gradients differ"
        rates = best_rates({"autograd": (by_autograd, 1), "closed form": (by_hand, 1)}, turns)
        name = f"{label}, autograd / closed-form gradients, batch {size}"
        results[name] = rates["autograd"] / rates["closed form"]
    return results


@dataclass(frozen=True)
class Turns:
    """Turns in which each side of a comparison is timed.

    Attributes:
        rounds: Number of turns of each side.
        seconds: CPU time of one turn.
    """

    rounds: int
    seconds: float


def best_rates(sides: dict[str, tuple[Update, int]], turns: Turns) -> dict[str, float]:
    """Return, for each side, the number of updates per CPU second in its best turn."""
    best = dict.fromkeys(sides, 0.0)
    for _ in range(turns.rounds):
        for name, (update, count) in sides.items():
            start, done = time.process_time(), 0
            while (elapsed := time.process_time() - start) < turns.seconds:
                update()
                done += count
            best[name] = max(best[name], done / elapsed)
    return best


def whole_way(folder: Path, turns: Turns) -> float:
    """Return the ratio of the CPU times from a log to a policy: mcap and d3rlpy to mcaprl."""
    log, part = folder / "log.mcap", folder / "part.mcap"
    vectors(LOG_ROWS).save(log)
    rivals.write_mcap(rivals.messages(vectors(int(LOG_ROWS * LOG_SHARE))), part)
    start = time.process_time()
    update = ours(mcaprl.open(log), "cql", 256)
    ours_s = time.process_time() - start
    start = time.process_time()
    columns = rivals.read_mcap(part)
    their_update = d3rlpys(logged(columns), "DiscreteCQLConfig", 256)
    theirs_s = (time.process_time() - start) / LOG_SHARE
    rates = best_rates({"ours": (update, 1), "theirs": (their_update, 1)}, turns)
    print(f"mcap and d3rlpy take {theirs_s / ours_s:.0f} times as long to load the log", flush=True)
    return (theirs_s + LOG_UPDATES / rates["theirs"]) / (ours_s + LOG_UPDATES / rates["ours"])


def logged(columns: dict[str, Any]) -> Any:
    """Return columns of episodes of equal length as an object with a dataset's attributes."""
    rows = len(columns["action"])
    return SimpleNamespace(
        observations=columns["observation"],
        actions=columns["action"],
        rewards=columns["reward"],
        terminated=np.zeros(rows, bool),
        truncated=np.arange(1, rows + 1) % EPISODE_STEPS == 0,
    )


def rows_of(size: int, turns: Turns) -> dict[str, float]:
    """Return the ratios of updates per second at one batch size."""
    data = transitions()
    sides = {
        "ddqn": (ours(data, "double-dqn", size), 1),
        "cql": (ours(data, "cql", size), 1),
        "four seeds": (ours(data, "cql", size, seeds=4), 4),
        "d3rlpy ddqn": (d3rlpys(data, "DoubleDQNConfig", size), 1),
        "d3rlpy cql": (d3rlpys(data, "DiscreteCQLConfig", size), 1),
        "sb3 dqn": (sb3s(data, size), 10),
    }
    rates = best_rates(sides, turns)
    return {
        f"{DDQN}, batch {size}": rates["ddqn"] / rates["d3rlpy ddqn"],
        f"{CQL}, batch {size}": rates["cql"] / rates["d3rlpy cql"],
        f"{SB3}, batch {size}": rates["ddqn"] / rates["sb3 dqn"],
        f"{SEEDS}, batch {size}": rates["four seeds"] / rates["cql"],
    }


def image_rows(turns: Turns) -> dict[str, float]:
    """Return the ratios of updates per second from images."""
    data = images()
    sides = {
        "default": (learner_of(data, "double-dqn", IMAGE_BATCH).update, 1),
        "nature": (learner_of(data, "double-dqn", IMAGE_BATCH, encoder="nature").update, 1),
        "sb3": (sb3s(data, IMAGE_BATCH), 10),
    }
    rates = best_rates(sides, turns)
    return {
        IMAGES: rates["default"] / rates["sb3"],
        SAME_NETWORK: rates["nature"] / rates["sb3"],
    }


def main() -> None:
    """Measure, print ratios, and write them to learning.json."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--turn-s", type=float, default=1.0)
    parser.add_argument("--only", choices=("256", "32", "images", "whole", "gradients"))
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    turns = Turns(arguments.rounds, arguments.turn_s)
    if arguments.only == "gradients":
        for name, ratio in (gradient_rows(256, turns) | gradient_rows(32, turns)).items():
            print(f"{name}: {ratio:.2f}")
        return
    results: dict[str, float] = {}
    if arguments.only and RESULTS.exists():
        results = json.loads(RESULTS.read_text())
    for size in (256, 32):
        if arguments.only in (None, str(size)):
            results |= rows_of(size, turns)
    if arguments.only in (None, "images"):
        results |= image_rows(turns)
    if arguments.only in (None, "whole"):
        with tempfile.TemporaryDirectory() as folder:
            results[WHOLE] = whole_way(Path(folder), turns)
    print(table := as_table(results))
    write_json(RESULTS, results)
    write_section("learning-speed", table)


def as_table(results: dict[str, float]) -> str:
    """Return the table as Markdown, with the goals and the versions."""
    lines = ["| what | times as fast | goal |", "|---|---|---|"]
    lines += [f"| {name} | {x:.2f} | {GOALS.get(name, '')} |" for name, x in results.items()]
    versions = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    return "\n".join([*lines, "", f"Versions: {versions}."])


if __name__ == "__main__":
    main()
