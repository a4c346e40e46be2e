"""Estimation of the probabilities of a log's actions under the unknown policy that chose them.

For the actions of a Box, these are densities, of a mixture of normal distributions.

A classifier of the actions (behavior cloning) is trained on a part of the episodes and predicts the
actions of the other episodes. Thus no episode's probabilities come from a network that was trained
on this episode (cross-fitting). The predictions are calibrated by a temperature, on episodes that
the network was not trained on: Guo et al., "On Calibration of Modern Neural Networks",
https://arxiv.org/abs/1706.04599. A share of the uniform distribution is added, because many
behavior policies choose some actions at random.

Densities have no temperature. Whether they are right is shown by the probability integral transform
(PIT): the probability of a smaller action than the logged one, for each part of an action given the
parts before it. If the densities are those of the behavior, these numbers are uniform in [0, 1].

    Rosenblatt, "Remarks on a multivariate transformation", 1952
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.errors import UsageError
from mcaprl.offline.algorithms.bc import BC, BoxBC
from mcaprl.offline.algorithms.config import BCConfig, BoxBCConfig
from mcaprl.offline.algorithms.heads import Mixture
from mcaprl.offline.algorithms.models import outputs_of_buffer
from mcaprl.offline.batches.buffer import TransitionBuffer, discrete_actions
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.statistics import EDGES

Floats = NDArray[np.float64]

FOLDS: Final = 5
UPDATES: Final = 2_000
_VALIDATED: Final = 0.15
"""Share of a fold's training episodes on which the predictions are calibrated."""
PIT_RANGES: Final = 10
LARGEST_PIT_ERROR: Final = 0.05
"""Difference of the PIT's shares from equal ones, above which densities are called wrong."""
_CHECKS = 20
"""Number of times that the network is scored during its training. The best weights are used."""
_TEMPERATURES = np.geomspace(0.25, 4.0, 17)
_UNIFORM_SHARES = np.array([0.0, 0.005, 0.01, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0])
_SMALLEST = 1e-6


@dataclass(frozen=True)
class FoldScore:
    """Quality of the predictions for one fold.

    Attributes:
        episodes: Number of episodes that were predicted.
        log_likelihood: Mean log probability of the actions taken.
        marginal: Value of `log_likelihood` if every prediction is equal to the action frequencies
            of the training episodes; for densities, to their normal distribution.
        uniform: `log_likelihood` of equal probabilities for all allowed actions; of the uniform
            density.
        temperature: Divisor of the network's logits; 1 for densities.
        uniform_share: Share of the uniform distribution in the prediction.
    """

    episodes: int
    log_likelihood: float
    marginal: float
    uniform: float
    temperature: float
    uniform_share: float


@dataclass(frozen=True)
class ReliabilityRange:
    """Calibration in one range of predicted probabilities. Each step has one prediction per action.

    Attributes:
        low, high: Range (low, high].
        predictions: Number of predictions.
        predicted: Mean predicted probability.
        observed: Share of the predictions whose action was taken.
    """

    low: float
    high: float
    predictions: int
    predicted: float
    observed: float


@dataclass(frozen=True)
class BehaviorEstimate:
    """Estimated behavior probabilities, with their quality.

    Attributes:
        dataset: The dataset with the estimates in `behavior`, marked as estimated.
        folds: Quality for each fold.
        reliability: Predicted and observed frequencies, by range of the predicted probability;
            empty for densities.
        calibration_error: Mean absolute difference between predicted and observed frequency,
            weighted by the number of predictions. For densities, half the sum of the absolute
            differences between `pit` and equal shares.
        log_likelihood: Mean log probability, or log density, of the actions taken.
        pit: Shares of the PIT in ten equal ranges; empty for probabilities.
    """

    dataset: Dataset = field(repr=False)
    folds: tuple[FoldScore, ...]
    reliability: tuple[ReliabilityRange, ...]
    calibration_error: float
    log_likelihood: float
    pit: tuple[float, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return everything but the dataset, as JSON types."""
        return {
            "folds": [vars(fold) for fold in self.folds],
            "reliability": [vars(one) for one in self.reliability],
            "calibration_error": self.calibration_error,
            "log_likelihood": self.log_likelihood,
            "pit": list(self.pit),
        }

    def __str__(self) -> str:
        """Return a one-line summary."""
        uniform = float(np.mean([fold.uniform for fold in self.folds]))
        marginal = float(np.mean([fold.marginal for fold in self.folds]))
        what, other, error = "log probability", "frequencies", "calibration error"
        if self.pit:
            what, other, error = "log density", "normal", "PIT differs from uniform by"
        text = (
            f"mean {what} {self.log_likelihood:.3f} ({other} {marginal:.3f}, uniform"
            f" {uniform:.3f}), {error} {self.calibration_error:.3f}, {len(self.folds)} folds"
        )
        is_wrong = self.pit and self.calibration_error > LARGEST_PIT_ERROR
        return f"{text}: the densities are wrong" if is_wrong else text


def estimate_behavior(
    dataset: Dataset,
    *,
    folds: int = FOLDS,
    updates: int = UPDATES,
    seed: int = 0,
    clip_actions: bool = False,
    on_update: Callable[[], None] = lambda: None,
) -> BehaviorEstimate:
    """Estimate the probability, or density, of each action under the policy that took it."""
    is_box = isinstance(dataset.action_space, spaces.Box)
    if not is_box:
        discrete_actions(dataset.action_space, "estimating behavior_prob")
    count = len(dataset.episode_lengths)
    if folds < 2 or updates < 1:
        raise UsageError(
            f"folds is {folds}, expected at least 2, and updates is {updates}, expected at least 1"
        )
    if count < max(folds, 3):
        raise UsageError(
            f"estimating {dataset.behavior_field.name} in {folds} folds needs"
            f" {max(folds, 3)} episodes or more; there are {count}"
        )
    config: BCConfig = BCConfig(updates=updates, normalize=True)
    if is_box:
        config = BoxBCConfig(
            updates=updates, head="mixture", clip_actions=clip_actions, relative=False
        )
    buffer = TransitionBuffer.from_dataset(dataset, config.packing)
    random = np.random.default_rng(seed)
    fold_of = random.permutation(count) % folds
    # Columns are the probabilities of all actions, or the density and the PIT of the logged one.
    predicted = np.empty((len(buffer), 1 + buffer.n_actions if is_box else buffer.n_actions))
    scores = []
    for fold in range(folds):
        held_out = fold_of == fold
        validated = _validation(~held_out, random)
        mine = np.repeat(held_out, dataset.episode_lengths)
        checked = np.repeat(validated, dataset.episode_lengths)
        training = buffer.with_weights((~mine & ~checked).astype(float))
        if isinstance(config, BoxBCConfig):
            learner = BoxBC(config, training, [seed + fold])
            found, score = _fitted_densities(learner, mine, checked, on_update)
        else:
            classifier = BC(config, training, [seed + fold])
            found, score = _fitted(classifier, _allowed(buffer), mine, checked, on_update)
        predicted[mine] = found[mine]
        scores.append(dataclasses.replace(score, episodes=int(held_out.sum())))
    if is_box:
        return _of_densities(dataset, predicted, tuple(scores))
    return _of_probabilities(dataset, predicted, buffer.actions.numpy(), tuple(scores))


def _of_probabilities(
    dataset: Dataset, predicted: Floats, actions: NDArray[np.int64], folds: tuple[FoldScore, ...]
) -> BehaviorEstimate:
    """Return the result for rows (N, A) of the probabilities of all actions."""
    taken = predicted[np.arange(len(actions)), actions].astype(np.float32)
    ranges = reliability(predicted, actions)
    pairs = sum(one.predictions for one in ranges)
    error = sum(one.predictions * abs(one.predicted - one.observed) for one in ranges) / pairs
    return BehaviorEstimate(
        dataset=dataset.with_behavior_probs(taken, estimated=True),
        folds=folds,
        reliability=ranges,
        calibration_error=float(error),
        log_likelihood=float(np.log(taken).mean()),
    )


def _of_densities(
    dataset: Dataset, predicted: Floats, folds: tuple[FoldScore, ...]
) -> BehaviorEstimate:
    """Return the result for rows (N, 1 + n) of log densities and PITs."""
    shares = pit_shares(predicted[:, 1:])
    return BehaviorEstimate(
        dataset=dataset.with_behavior_log_probs(predicted[:, 0], estimated=True),
        folds=folds,
        reliability=(),
        calibration_error=float(np.abs(shares - 1 / PIT_RANGES).sum() / 2),
        log_likelihood=float(predicted[:, 0].mean()),
        pit=tuple(shares.tolist()),
    )


def pit_shares(pit: Floats) -> Floats:
    """Return the shares of numbers within [0, 1] in `PIT_RANGES` equal ranges."""
    counts, _ = np.histogram(pit, PIT_RANGES, (0.0, 1.0))
    shares: Floats = counts / counts.sum()
    return shares


def reliability(predicted: Floats, actions: NDArray[np.int64]) -> tuple[ReliabilityRange, ...]:
    """Compare predicted probabilities (N, A) with the frequencies of the actions (N,)."""
    taken = np.zeros(predicted.shape, bool)
    taken[np.arange(len(actions)), actions] = True
    place = np.searchsorted(EDGES, predicted.ravel())
    found = []
    for k in np.unique(place).tolist():
        here = place == k
        found.append(
            ReliabilityRange(
                low=EDGES[k - 1] if k else 0.0,
                high=EDGES[min(k, len(EDGES) - 1)],
                predictions=int(here.sum()),
                predicted=float(predicted.ravel()[here].mean()),
                observed=float(taken.ravel()[here].mean()),
            )
        )
    return tuple(found)


def _validation(training: NDArray[np.bool_], random: np.random.Generator) -> NDArray[np.bool_]:
    """Choose the training episodes (E,) for validation: at least one, but not all."""
    chosen = np.zeros(len(training), bool)
    episodes = random.permutation(np.flatnonzero(training))
    chosen[episodes[: max(round(_VALIDATED * len(episodes)), 1)]] = True
    return chosen


def _allowed(buffer: TransitionBuffer) -> NDArray[np.bool_]:
    """Return the allowed actions (N, A) of each step."""
    mask = buffer.observe(buffer.places[0]).mask
    if mask is None:
        return np.ones((len(buffer), buffer.joint.count), bool)
    return mask.numpy().astype(bool)


def _fitted(
    learner: BC,
    allowed: NDArray[np.bool_],
    held_out: NDArray[np.bool_],
    validated: NDArray[np.bool_],
    on_update: Callable[[], None],
) -> tuple[Floats, FoldScore]:
    """Train a network; return its best predictions (N, A), and the score of these predictions."""
    buffer, updates = learner.buffer, learner.config.updates
    actions = buffer.actions.numpy()
    checks = set(np.linspace(0, updates, _CHECKS + 1).round().astype(int).tolist())
    best: Floats = np.empty((0, 0))
    best_score, best_fit = -np.inf, (1.0, 0.0)
    for number in range(1, updates + 1):
        learner.update()
        on_update()
        if number in checks:
            with torch.no_grad():
                logits = outputs_of_buffer(learner.models["logits"], buffer, next_states=False)
            raw = np.where(allowed, logits.numpy().astype(np.float64), -np.inf)
            score, *fit = _calibrated(raw[validated], actions[validated])
            if score > best_score:
                best, best_score, best_fit = raw, score, (fit[0], fit[1])
    probabilities = _probabilities(best, *best_fit)
    frequencies = np.bincount(actions[~held_out], minlength=best.shape[1]) + 1.0
    marginal = np.log(frequencies / frequencies.sum())[actions[held_out]]
    own = probabilities[held_out, actions[held_out]]
    return probabilities, FoldScore(
        episodes=0,
        log_likelihood=float(np.log(own).mean()),
        marginal=float(marginal.mean()),
        uniform=float(-np.log(allowed[held_out].sum(axis=1)).mean()),
        temperature=best_fit[0],
        uniform_share=best_fit[1],
    )


def _fitted_densities(
    learner: BoxBC,
    held_out: NDArray[np.bool_],
    validated: NDArray[np.bool_],
    on_update: Callable[[], None],
) -> tuple[Floats, FoldScore]:
    """Train a network; return its log densities and PITs (N, 1 + n), and their score."""
    # The densities are in the units of the space.
    buffer, updates = learner.buffer, learner.config.updates
    box, actions = buffer.box, buffer.actions
    assert box is not None
    uniform = -box.size * float(np.log(2))
    checks = set(np.linspace(0, updates, _CHECKS + 1).round().astype(int).tolist())
    best_score, best_share, best = -np.inf, 0.0, torch.empty(0)
    for number in range(1, updates + 1):
        learner.update()
        on_update()
        if number in checks:
            outputs = outputs_of_buffer(learner.models["actor"], buffer, next_states=False)
            own = Mixture.log_density(outputs, actions).double().numpy()
            means = [_mixed(own[validated], uniform, share).mean() for share in _UNIFORM_SHARES]
            share = int(np.argmax(means))
            if means[share] > best_score:
                best_score, best_share = float(means[share]), float(_UNIFORM_SHARES[share])
                best = outputs
    log_densities = _mixed(Mixture.log_density(best, actions).double().numpy(), uniform, best_share)
    pit = Mixture.pit(best, actions, best_share).double().numpy()
    found = np.hstack([log_densities[:, None] + box.log_scale, pit.clip(0, 1)])
    others = actions.numpy()[~held_out].astype(np.float64)
    scaled = (actions.numpy()[held_out] - others.mean(0)) / others.std(0)
    normal = -0.5 * np.square(scaled) - np.log(others.std(0)) - 0.5 * np.log(2 * np.pi)
    return found, FoldScore(
        episodes=0,
        log_likelihood=float(found[held_out, 0].mean()),
        marginal=float(normal.sum(1).mean()) + box.log_scale,
        uniform=uniform + box.log_scale,
        temperature=1.0,
        uniform_share=best_share,
    )


def _mixed(log_densities: Floats, uniform: float, share: float) -> Floats:
    """Return log densities that are mixed with the uniform distribution."""
    with np.errstate(divide="ignore"):
        mixed: Floats = np.logaddexp(np.log1p(-share) + log_densities, np.log(share) + uniform)
    return mixed


def _calibrated(logits: Floats, actions: NDArray[np.int64]) -> tuple[float, float, float]:
    """Return the best mean log probability, with its temperature and uniform share."""
    candidates = []
    for temperature in _TEMPERATURES.tolist():
        own = _probabilities(logits, temperature, 0.0)[np.arange(len(actions)), actions]
        uniform = _UNIFORM_SHARES / np.isfinite(logits).sum(axis=1)[:, None]
        mixed = (1 - _UNIFORM_SHARES) * own[:, None] + uniform
        means = np.log(np.maximum(mixed, _SMALLEST)).mean(axis=0)
        share = int(means.argmax())
        candidates.append((float(means[share]), temperature, float(_UNIFORM_SHARES[share])))
    return max(candidates)


def _probabilities(logits: Floats, temperature: float, uniform_share: float) -> Floats:
    """Return the softmax (N, A) of scaled logits, mixed with the uniform distribution."""
    own = torch.softmax(torch.from_numpy(logits / temperature), dim=1).numpy()
    allowed = np.isfinite(logits)
    uniform = allowed / allowed.sum(axis=1, keepdims=True)
    mixed: Floats = (1 - uniform_share) * own + uniform_share * uniform
    return np.clip(mixed, np.where(allowed, _SMALLEST, 0.0), 1.0)
