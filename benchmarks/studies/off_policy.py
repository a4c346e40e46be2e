"""Compare off-policy estimates with other libraries, and measure the coverage of their intervals.

    python -m benchmarks.studies.off_policy

The program makes three comparisons:

- Importance sampling: the largest difference from SCOPE-RL's five estimators on the same logs.
- Fitted Q evaluation: the estimates of d3rlpy's DiscreteFQE on the same log, policy and settings,
  and the policy's true returns in the sim.
- Coverage: the fraction of `--logs` logs whose 95 % interval contains the true value. The task has
  a known value, the solution of linear equations (tests/support/two_state_task.py).

The first comparison needs SCOPE-RL, the second one needs d3rlpy (`make bench-learning` installs
both). If a library is not installed, its comparison is left out with a message.
"""

from __future__ import annotations

import argparse
import importlib.util
import warnings
from contextlib import closing
from typing import Any, Final

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

import mcaprl
from mcaprl.offline import ESTIMATORS, EpisodeTable, FQEConfig, OffPolicyEvaluator
from mcaprl.sims import Policy
from tests.support import two_state_task as task

SCOPE_RL_NAMES: Final = {
    "TIS": "TrajectoryWiseImportanceSampling",
    "WIS": "SelfNormalizedTIS",
    "PDIS": "PerDecisionImportanceSampling",
    "WPDIS": "SelfNormalizedPDIS",
    "DR": "DoublyRobust",
}
"""Names of the estimators in SCOPE-RL.

WDR is missing: SCOPE-RL's self-normalized DR does not normalize the importance weights of V, so it
is another estimator.
"""


def beside_scope_rl(logs: int) -> dict[str, float]:
    """Return the largest relative difference from SCOPE-RL's estimates on logs of 300 episodes."""
    from scope_rl.ope.discrete import basic_estimators

    worst = dict.fromkeys(SCOPE_RL_NAMES, 0.0)
    for seed in range(logs):
        table = task.play(None, episodes=300, seed=seed)
        # SCOPE-RL needs pi, mu and Q of two actions. They are chosen so that the ratios, Q and V
        # equal those of the table.
        given = _as_scope_rl(table)
        for name, theirs in SCOPE_RL_NAMES.items():
            estimator = getattr(basic_estimators, theirs)()
            wanted = {k: v for k, v in given.items() if name == "DR" or "value" not in k}
            other = estimator.estimate_policy_value(**wanted)
            mine = float(ESTIMATORS[name](table).values(np.ones((1, 300)))[0])
            worst[name] = max(worst[name], abs(mine - other) / abs(other))
    return worst


def _as_scope_rl(table: EpisodeTable) -> dict[str, Any]:
    """Return an episode table in SCOPE-RL's format. All logged actions have the number 0."""
    pi = np.minimum(0.5, table.ratios / 4).ravel()
    # Action 1 gets the remaining probability. Its Q is chosen so that the mean of Q under pi is the
    # table's V.
    other = (table.v.ravel() - pi * table.q.ravel()) / (1 - pi)
    return {
        "step_per_trajectory": table.rewards.shape[1],
        "action": np.zeros(table.rewards.size, dtype=np.int64),
        "reward": table.rewards.ravel(),
        "pscore": pi / table.ratios.ravel(),
        "evaluation_policy_action_dist": np.stack([pi, 1 - pi], axis=1),
        "state_action_value_prediction": np.stack([table.q.ravel(), other], axis=1),
        "gamma": table.gamma,
    }


class Balance(Policy):
    """A CartPole policy without training: it pushes to the side to which the pole falls."""

    def __init__(self, look_ahead_s: float) -> None:
        """Store how many seconds the policy looks ahead; with 0 seconds, the pole falls soon."""
        self._look_ahead_s = look_ahead_s

    def act(self, observations: NDArray[np.floating]) -> NDArray[np.int64]:
        """Return actions (B,): 1 pushes to the right."""
        angle, speed = observations[:, 2], observations[:, 3]
        return (angle + self._look_ahead_s * speed > 0).astype(np.int64)

    def action_probabilities(self, observations: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return one-hot probabilities (B, 2)."""
        return np.eye(2)[self.act(observations)]


FQE: Final = FQEConfig(
    updates=6_000,
    batch_size=128,
    hidden=(64, 64),
    learning_rate=1e-3,
    final_learning_rate_fraction=1.0,
    gamma=0.97,
    target_interval=30,
)
POLICIES: Final = {"looks ahead": Balance(0.3), "looks at the angle": Balance(0.0)}
EPSILON: Final = 0.5


def cartpole(policy: Balance, epsilon: float, episodes: int, seed: int) -> dict[str, Any]:
    """Run an epsilon-greedy policy, and return the columns for `Dataset.from_arrays`."""
    random = np.random.default_rng(seed)
    rows = []
    with closing(gym.make("CartPole-v1")) as env:
        for episode in range(episodes):
            observation, _ = env.reset(seed=seed * 100_000 + episode)
            ended = False
            while not ended:
                best = int(policy.act(observation[None])[0])
                action = int(random.integers(2)) if random.random() < epsilon else best
                prob = epsilon / 2 + (1 - epsilon) * (action == best)
                after, reward, terminated, truncated, _ = env.step(action)
                rows.append((observation, action, reward, terminated, truncated, after, prob))
                observation, ended = after, terminated or truncated
    names = ("observations", "actions", "rewards", "terminated", "truncated")
    names += ("next_observations", "behavior_probs")
    return {name: np.array([row[k] for row in rows]) for k, name in enumerate(names)}


def true_value(policy: Balance, episodes: int = 200) -> float:
    """Return the policy's mean discounted return over fresh episodes."""
    played = cartpole(policy, 0.0, episodes, seed=9)
    ends = np.flatnonzero(played["terminated"] | played["truncated"])
    lengths = np.diff(ends, prepend=-1)
    # Each step has a reward of 1.
    return float(((1 - FQE.gamma**lengths) / (1 - FQE.gamma)).mean())


def ours(columns: dict[str, Any], policy: Balance, seed: int) -> float:
    """Return our FQE estimate."""
    data = mcaprl.Dataset.from_arrays(**columns, env_id="CartPole-v1")
    return OffPolicyEvaluator(data, FQE, seed).evaluate(policy, "").estimates[0].value or 0.0


def d3rlpys(columns: dict[str, Any], policy: Balance, seed: int) -> float:
    """Return the estimate of d3rlpy's FQE with the same settings.

    The estimate is the mean value of the first states.
    """
    import d3rlpy
    from d3rlpy.ope.fqe import DiscreteFQE
    from d3rlpy.ope.fqe import FQEConfig as TheirConfig

    class Acting:
        """Evaluated policy, with the methods that DiscreteFQE calls."""

        @property
        def impl(self) -> Acting:
            return self

        def predict_best_action(self, observations: torch.Tensor) -> torch.Tensor:
            return torch.from_numpy(policy.act(observations.numpy()))

    d3rlpy.seed(seed)
    log = d3rlpy.dataset.MDPDataset(
        columns["observations"],
        columns["actions"],
        columns["rewards"].astype(np.float32),
        columns["terminated"].astype(np.float32),
        columns["truncated"].astype(np.float32),
        action_space=d3rlpy.ActionSpace.DISCRETE,
        action_size=2,
    )
    config = TheirConfig(
        learning_rate=FQE.learning_rate,
        encoder_factory=d3rlpy.models.VectorEncoderFactory(list(FQE.hidden)),
        batch_size=FQE.batch_size,
        gamma=FQE.gamma,
        target_update_interval=FQE.target_interval,
    )
    learner = DiscreteFQE(Acting(), config)
    learner.build_with_dataset(log)
    for _ in range(FQE.updates):
        learner.update(log.sample_transition_batch(FQE.batch_size))
    firsts = np.array([episode.observations[0] for episode in log.episodes])
    return float(learner.predict_value(firsts, policy.act(firsts)).mean())


def beside_d3rlpy(seeds: int) -> None:
    """Print FQE estimates of mcaprl and d3rlpy, and true values; each seed has its own log."""
    print("| policy | true | ours, mean and spread | d3rlpy's | our error | d3rlpy's error |")
    for name, policy in POLICIES.items():
        found = []
        for seed in range(seeds):
            columns = cartpole(POLICIES["looks ahead"], EPSILON, 100, seed)
            found.append([ours(columns, policy, seed), d3rlpys(columns, policy, seed)])
        values, true = np.array(found), true_value(policy)
        cells = [f"{one.mean():.2f} +- {one.std(ddof=1):.2f}" for one in values.T]
        errors = [f"{error:.2f}" for error in np.abs(values - true).mean(0)]
        print("|", " | ".join([name, f"{true:.2f}", *cells, *errors]), "|", flush=True)


def coverage(logs: int, episodes: int) -> dict[str, dict[str, float]]:
    """Return the fraction of logs whose interval contains the true value, for each estimator.

    Returns:
        Fractions for our intervals (`ours`), and for percentile intervals (`percentiles`) of the
        same bootstrap samples.
    """
    held = {kind: dict.fromkeys(ESTIMATORS, 0.0) for kind in ("ours", "percentiles")}
    for seed in range(logs):
        table = task.play(None, episodes=episodes, seed=seed)
        random = np.random.default_rng(seed)
        counts = random.multinomial(episodes, [1 / episodes] * episodes, 1000).astype(np.float64)
        for name, estimator in ESTIMATORS.items():
            estimate = estimator(table)
            low, high = np.percentile(estimate.values(counts), (2.5, 97.5))
            for kind, (start, end) in (
                ("ours", estimate.interval(counts)),
                ("percentiles", (low, high)),
            ):
                held[kind][name] += (start <= task.true_value() <= end) / logs
    return held


def main() -> None:
    """Run the comparisons and measure the coverage; print all results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=1000, help="number of logs for the coverage")
    parser.add_argument("--seeds", type=int, default=4, help="number of seeds of both FQEs")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    if importlib.util.find_spec("scope_rl"):
        worst = beside_scope_rl(20)
        print("largest relative difference to SCOPE-RL:")
        print("  " + ", ".join(f"{name} {difference:.1e}" for name, difference in worst.items()))
    else:
        print("SCOPE-RL is not installed: not compared")
    if importlib.util.find_spec("d3rlpy"):
        beside_d3rlpy(arguments.seeds)
    else:
        print("d3rlpy is not installed: not compared")
    for episodes in (50, 300):
        print(f"{arguments.logs} logs of {episodes} episodes; 95 % intervals with the true value:")
        for kind, shares in coverage(arguments.logs, episodes).items():
            text = ", ".join(f"{name} {share:.1%}" for name, share in shares.items())
            print(f"  {kind}: {text}", flush=True)


if __name__ == "__main__":
    main()
