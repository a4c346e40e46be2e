"""Off-policy evaluation: estimates of the values of policies from logs."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final

from gymnasium import spaces

from mcaprl.api.policies import Names, as_names, policy_names, trained_policies
from mcaprl.api.ranges import check_fraction, check_least
from mcaprl.api.train import torch_threads
from mcaprl.base_policy import BasePolicy, RandomPolicy
from mcaprl.errors import PolicyError
from mcaprl.progress import ProgressBar, no_progress
from mcaprl.recorder.dataset.statistics import Calibration, calibration
from mcaprl.recorder.source import Data, named, opened
from mcaprl.texts import counted

UPDATES: Final = 10_000
BOX_UPDATES: Final = 3_000

if TYPE_CHECKING:
    from mcaprl.offline.estimate.behavior import BehaviorEstimate
    from mcaprl.offline.estimate.box import BehaviorCheck
    from mcaprl.offline.estimate.off_policy import Estimate, OffPolicyEvaluator, PolicyEstimates
    from mcaprl.recorder.dataset.dataset import Dataset


@dataclass(frozen=True)
class LogEstimates:
    """Values of policies, estimated from logs.

    Attributes:
        data: Names of the logs.
        episodes: Number of episodes.
        gamma: Discount of all values.
        epsilon: Probability with which the evaluated policies take a random action.
        behavior_return: Mean discounted return of the logged episodes.
        behavior_interval: 95 % confidence interval of that mean.
        behavior_calibration: Two numbers that should be about equal: the mean of
            1 / `behavior_prob`, and the number of actions in the action space. None if unknown.
        behavior_estimate: Quality of the estimated `behavior_prob`; None if it was not estimated
            for this evaluation.
        coverage: Mean probability of the logged actions under each policy; empty for a Box.
        estimates: Estimate of each policy by each estimator.
        ranking: Order of the policies, best first; None for one policy.
        behavior_check: FQE's value of the behavior beside the logged returns, for a Box. If it is
            off, the estimates by FQE are refused. None for discrete actions.
        support: Fraction of each policy's actions that are as near to logged ones as 95 % of the
            log's own; empty for discrete actions, and if all observations are images.
    """

    data: str
    episodes: int
    gamma: float
    epsilon: float
    behavior_return: float
    behavior_interval: tuple[float, float]
    behavior_calibration: Calibration | None
    behavior_estimate: BehaviorEstimate | None
    coverage: dict[str, float]
    estimates: tuple[Estimate, ...]
    ranking: dict[str, Any] | None
    behavior_check: BehaviorCheck | None = None
    support: dict[str, float] = field(default_factory=dict)

    @property
    def is_ranked(self) -> bool:
        """Whether the log supports an order of the policies, for a Box that of FQE."""
        if self.ranking is None:
            return False
        return bool(self.behavior_check.passes if self.behavior_check else self.ranking["trusted"])

    def answers(self) -> dict[str, str]:
        """Return for each policy in one line: its value, beside the log's, how sure, what next."""
        policies = dict.fromkeys(each.policy for each in self.estimates)
        return {policy: self._answer(policy) for policy in policies}

    def _answer(self, policy: str) -> str:
        from mcaprl.offline.estimate.off_policy import PREFERENCE

        found = {one.estimator: one for one in self.estimates if one.policy == policy}
        log = f"the log's {self.behavior_return:.3f}"
        usable = [found[name] for name in PREFERENCE if name in found and found[name].trusted]
        if usable and (value := usable[0].value) is not None and usable[0].interval is not None:
            low, high = usable[0].interval
            text = f"{value:.3f} ({low:.3f} to {high:.3f}) by {usable[0].estimator}"
            if low > self.behavior_interval[1]:
                return f"{text}: better than {log}; try it, and record that"
            if high < self.behavior_interval[0]:
                return f"{text}: worse than {log}; train on, or with another algorithm"
            return f"{text}: as good as {log}, as far as it shows; record more episodes"
        model = found.get("FQE")
        is_right = self.behavior_check is not None and self.behavior_check.passes
        if is_right and model is not None and model.value is not None and not model.is_refused:
            spread = "" if model.spread is None else f" +- {model.spread:.3f} over its seeds"
            return (
                f"{model.value:.3f}{spread} by FQE, beside {log}: good for an order, without an"
                " interval; try the best, and record that"
            )
        effective = [one.effective_sample_size or 0.0 for one in found.values()]
        return (
            f"unknown, beside {log}: the log supports no estimate (at best {max(effective):.1f}"
            " effective episodes); try it in a sim, or record actions more like its own"
        )

    def to_json(self) -> dict[str, Any]:
        """Return what `evaluate --data --json` prints."""
        calibrated, estimated = self.behavior_calibration, self.behavior_estimate
        checked = self.behavior_check
        return {
            **vars(self),
            "behavior_interval": list(self.behavior_interval),
            "behavior_calibration": calibrated
            and {**calibrated.to_json(), "text": str(calibrated)},
            "behavior_estimate": estimated and {**estimated.to_json(), "text": str(estimated)},
            "behavior_check": checked and {**checked.to_json(), "text": str(checked)},
            "estimates": [estimate.to_json() for estimate in self.estimates],
            "answers": self.answers(),
        }


def estimate(
    policies: Names,
    data: Data,
    *,
    gamma: float = 0.97,
    epsilon: float = 0.0,
    updates: int | None = None,
    estimate_behavior: bool = False,
    clip_actions: bool = False,
    seed: int = 1_000_000,
    threads: int = 1,
    progress: ProgressBar = no_progress,
) -> LogEstimates:
    """Estimate the discounted returns of policies from logs, with each estimator.

    For the actions of a Box, these are FQE, which evaluates the actions of `act`, and estimators
    with importance weights, which evaluate actions that are drawn from the policy's densities.

    Args:
        policies: `random`, the path of a trained run, or a list of these. Each seed of a run is
            one policy.
        data: Dataset, file, folder or glob of logs, or several of them.
        gamma: Discount of the returns.
        epsilon: Probability of a random action instead of the policy's; 0 for a Box.
        updates: Number of gradient steps of the model that FQE, DR and WDR use; by default 10,000,
            and 3,000 for a Box, where there are four models instead of one. The model that
            estimates the behavior is trained with at most 2,000 steps.
        estimate_behavior: Whether `mcaprl.estimate_behavior` estimates the behavior probabilities
            or densities from the actions. Otherwise, the logged ones are used.
        clip_actions: Whether logged actions outside a Box are clipped to its bounds instead of
            being an error.
        seed: Seed of the model and of the resampling.
        threads: Number of threads of PyTorch and of the reader.
        progress: Function that opens a progress bar.

    Raises:
        UsageError: A number is out of range.
        UnknownNameError: There is no such policy.
        PolicyError: A policy was trained on other spaces than those of the logs.
        LogError: The logs cannot be read.
    """
    from mcaprl.offline.estimate.box import SEEDS, BoxEvaluator
    from mcaprl.offline.estimate.off_policy import FOLDS, ranking

    check_fraction(gamma=gamma, epsilon=epsilon)
    check_least(0, seed=seed)
    check_least(1, threads=threads, **({} if updates is None else {"updates": updates}))
    dataset = opened(data, threads=threads)
    is_box = isinstance(dataset.action_space, spaces.Box)
    updates = updates or (BOX_UPDATES if is_box else UPDATES)
    found = _policies(as_names(policies), dataset, seed)
    behavior = None
    if estimate_behavior:
        steps = min(updates, 2_000)
        behavior = _estimate_behavior(
            dataset,
            updates=steps,
            seed=seed,
            clip_actions=clip_actions,
            threads=threads,
            progress=progress,
        )
        dataset = behavior.dataset
    evaluator = _evaluator(dataset, gamma, updates, seed, clip_actions=clip_actions)
    results: list[PolicyEstimates] = []
    # FQE evaluates the behavior of a log with the actions of a Box, too.
    models = len(found) + is_box
    networks = models * FOLDS * (SEEDS if is_box else 1)
    text = f"fitting {counted(networks, 'network')} with {counted(updates, 'update')} each"
    with torch_threads(threads), progress(text, models * evaluator.updates_of_model) as advance:
        for name, policy in found.items():
            results.append(
                evaluator.evaluate(policy, name, epsilon=epsilon, on_update=lambda: advance(1))
            )
    estimates = [one for result in results for one in result.estimates]
    return LogEstimates(
        named(data),
        len(dataset.episodes),
        gamma,
        epsilon,
        evaluator.behavior_return,
        evaluator.behavior_interval,
        calibration(dataset.behavior, dataset.action_space),
        behavior,
        {one.policy: one.coverage for one in results if one.coverage is not None},
        tuple(estimates),
        ranking(estimates) if len(found) > 1 else None,
        evaluator.check_behavior() if isinstance(evaluator, BoxEvaluator) else None,
        {one.policy: one.support for one in results if one.support is not None},
    )


def _evaluator(
    dataset: Dataset, gamma: float, updates: int, seed: int, *, clip_actions: bool
) -> OffPolicyEvaluator:
    """Return the evaluator for the actions of a dataset."""
    from mcaprl.offline.estimate.box import BoxEvaluator
    from mcaprl.offline.estimate.evidence import fqe_config
    from mcaprl.offline.estimate.fqe import FQEConfig
    from mcaprl.offline.estimate.off_policy import OffPolicyEvaluator

    if isinstance(dataset.action_space, spaces.Box):
        model = replace(fqe_config(gamma, updates, is_box=True), clip_actions=clip_actions)
        return BoxEvaluator(dataset, model, seed)
    config = replace(FQEConfig(), gamma=gamma, updates=updates)
    return OffPolicyEvaluator(dataset, config, seed)


def _policies(names: Sequence[str], dataset: Dataset, seed: int) -> dict[str, BasePolicy]:
    """Load the policies, and return them by their names in tables; `random` draws by the seed."""
    shown = policy_names(names)
    found: dict[str, BasePolicy] = {}
    for name in dict.fromkeys(names):
        if name == "random":
            space = copy.deepcopy(dataset.action_space)
            space.seed(seed)
            found[name] = RandomPolicy(space)
            continue
        loaded = trained_policies(name, dataset)
        for policy in loaded:
            if policy.chunk.has_memory:
                raise PolicyError(
                    f"{name} predicts {policy.chunk}: the value of a state depends on what was"
                    " predicted before; evaluate it in a sim, or train it with `execute=1`"
                )
            found[policy.name if len(loaded) > 1 else shown[name]] = policy
    return found


def estimate_behavior(
    data: Data,
    *,
    folds: int = 5,
    updates: int = 2_000,
    seed: int = 0,
    clip_actions: bool = False,
    threads: int = 1,
    progress: ProgressBar = no_progress,
) -> BehaviorEstimate:
    """Estimate the probability of each logged action under the policy that took it.

    Most robots do not log these probabilities, but estimators with importance weights need them.
    The episodes are split into folds. For each fold, a classifier is trained on most episodes of
    the other folds and calibrated on the rest of them. The classifier then predicts the actions of
    the fold. For the actions of a Box, a mixture of normal distributions takes its place, and the
    estimates are densities.

    Args:
        data: Dataset, file, folder or glob of logs, or several of them.
        folds: Number of folds of the episodes; the actions of each fold are predicted by a
            classifier trained on the other folds.
        updates: Number of gradient steps for each fold.
        seed: Seed of the folds and of the networks.
        clip_actions: Whether logged actions outside a Box are clipped to its bounds instead of
            being an error.
        threads: Number of threads of PyTorch and of the reader.
        progress: Function that opens a progress bar.

    Returns:
        The dataset with the estimates, which are marked as estimates, and their calibration.

    Raises:
        SpaceError: The actions are neither discrete nor floats of a Box.
        UsageError: There are too few episodes.
        LogError: The logs cannot be read.
    """
    from mcaprl.offline.estimate import behavior

    check_least(1, updates=updates, threads=threads)
    check_least(2, folds=folds)
    dataset = opened(data, threads=threads)
    text = f"estimating {dataset.behavior_field.name} in {folds} folds"
    with torch_threads(threads), progress(text, folds * updates) as advance:
        return behavior.estimate_behavior(
            dataset,
            folds=folds,
            updates=updates,
            seed=seed,
            clip_actions=clip_actions,
            on_update=lambda: advance(1),
        )


_estimate_behavior = estimate_behavior  # A parameter of `estimate` has its name
