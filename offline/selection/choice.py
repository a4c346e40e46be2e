"""Outcome of `auto`, stored as `choice.json` of the run: the candidates, the choice, the reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from mcaprl.errors import TrainingError
from mcaprl.files import read_json, write_json
from mcaprl.offline.estimate.box import BehaviorCheck
from mcaprl.offline.estimate.off_policy import LEAST_SAMPLE_SIZE
from mcaprl.page import COLORS, PALE, Figure, Section, Table, new_figure, tick_labels, write_page
from mcaprl.texts import counted

CHOICE_NAME: Final = "choice.json"
COLUMNS: Final = (
    "candidate",
    "updates",
    "estimate (95 % interval)",
    "best",
    "as logged",
    "Bellman error",
    "WPDIS",
    "outcome",
)
EXPLANATION: Final = (
    "Estimates are discounted returns from the first states of the logged episodes, by pessimistic"
    " FQE. best: fraction of the resamplings in which the candidate is the best in the last"
    " evaluation. as logged: fraction of the states in which the candidate takes the logged action."
    " Bellman error: root mean square of r + gamma max Q(s', a) - Q(s, a), divided by the standard"
    " deviation of Q. WPDIS:"
    " estimate by weighted importance sampling, or the effective number of episodes if there are"
    " too few."
)
_OTHERS: Final = (
    "Their estimates are from the first evaluation, after a part of the updates, and cannot be"
    " compared with those of the finalists."
)
FINALISTS: Final = ("chosen", "runner-up", "")  # Outcomes of the candidates of the last evaluation
_MEANINGS: Final = {
    "return_spread": "standard deviation of the returns of the episodes",
    "terminated": "fraction of the episodes that end in a terminal state",
    "entropy": "randomness of the behavior: 0 for a single action, 1 for all equally often",
    "coverage": "fraction of the actions that are likely in the log, over the states",
    "probabilities": "whether the log has the probabilities of its actions",
    "problems": "what mcaprl info reports",
}
STOPPED_EARLY: Final = "stopped early"
"""Outcome of a candidate that was not trained with all updates, or cannot be chosen."""
DETERMINISTIC: Final = 0.05
"""If the entropy of the behavior policy is lower, candidates are rated by agreement with it."""
ESTIMATE, AGREEMENT, PRIOR, UNTESTED = "estimate", "agreement", "prior order", "untested"
"""Rules that decide."""
_FEW_EPISODES: Final = 50
_LOW_COVERAGE: Final = 0.5


@dataclass(frozen=True)
class LogTraits:
    """Properties of a log that determine which algorithms may work."""

    episodes: int
    transitions: int
    mean_return: float  # Mean undiscounted return of the episodes
    return_spread: float  # Standard deviation of these returns
    terminated: float  # Fraction of the episodes that end in a terminal state
    # Mean entropy of the behavior policy, from 0 (deterministic) to 1 (uniform). If all logged
    # probabilities are valid, it is computed from them, otherwise from the clone.
    entropy: float
    coverage: float  # Mean fraction of the actions that are likely under the behavior policy
    probabilities: bool  # Whether the log has the probabilities of its actions
    problems: tuple[str, ...]  # Problems that the lint found

    @property
    def is_deterministic(self) -> bool:
        """Whether the behavior is almost deterministic."""
        return self.entropy < DETERMINISTIC


@dataclass(frozen=True)
class Rating:
    """Estimates of one candidate."""

    value: float  # Mean estimated discounted return of the episodes
    interval: tuple[float, float]  # 95 % interval of that mean, by resampling
    agreement: float  # Mean over episodes of the fraction of states with the logged action
    score: float  # `value`, or `agreement` if the behavior is almost deterministic
    best_chance: float  # Fraction of the resamplings in which no other candidate has a larger score

    def __str__(self) -> str:
        """Return the value with its interval."""
        low, high = self.interval
        return f"{self.value:.4g} ({low:.4g} to {high:.4g})"


@dataclass(frozen=True)
class Tried:
    """Results of one candidate."""

    # Number of updates at the last evaluation of the candidate. If there was no evaluation, the
    # current number of updates.
    updates: int = 0
    rating: Rating | None = None  # Its estimate; None if it was not evaluated
    # Fraction of the states in which its action is likely under the behavior policy.
    support: float | None = None
    bellman_error: float | None = None  # Its relative Bellman error; None if it has no Q-values
    # Estimate by WPDIS, and the effective number of episodes of this estimate; None if the log has
    # no action probabilities.
    weighted: tuple[float, float] | None = None
    outcome: str = ""  # `chosen`, `runner-up`, `stopped early`, or why it was not trained
    # What the models predict for the behavior; None for finite action spaces.
    check: BehaviorCheck | None = None

    def row(self, name: str) -> tuple[str, ...]:
        """Return the row of the table of candidates."""
        rating, weighted = self.rating, "-"
        # Candidates that were stopped early do not take part in the last evaluation.
        rated = rating is not None and self.outcome != STOPPED_EARLY
        if self.weighted is not None:
            value, size = self.weighted
            weighted = f"{value:.4g}" if size >= LEAST_SAMPLE_SIZE else f"refused ({size:.1f})"
        return (
            name,
            str(self.updates),
            str(rating or "-"),
            f"{rating.best_chance:.0%}" if rating and rated else "-",
            f"{rating.agreement:.0%}" if rating else "-",
            "-" if self.bellman_error is None else f"{self.bellman_error:.2f}",
            weighted,
            self.outcome,
        )


def decide(
    ratings: Mapping[str, Rating], prior: Sequence[str], check: BehaviorCheck | None
) -> tuple[str, str]:
    """Choose by the estimates if they can be trusted, else by the prior; return the rule, too."""
    # They can if they are right for the behavior, and the interval of the largest estimate is above
    # that of the first candidate of `prior`.
    best, usual = next(iter(ratings)), prior[0]
    if check is None or not check.passes:
        return usual, PRIOR
    if best == usual or ratings[best].interval[0] > ratings[usual].interval[1]:
        return best, ESTIMATE
    return usual, PRIOR


@dataclass(frozen=True)
class Choice:
    """Policy that `auto` chose, and the reason."""

    chosen: str  # Name of the candidate
    reason: str  # Why it was chosen, in words
    confidence: str
    advice: tuple[str, ...]  # What data would raise this confidence, in words
    complete: bool  # Whether all planned training and evaluation was done within the budget
    traits: LogTraits  # Properties of the log
    tried: dict[str, Tried]  # What is known of each candidate, by name, from the best to the worst
    rule: str = ""  # Rule that decided: `ESTIMATE`, `AGREEMENT`, `PRIOR` or `UNTESTED`

    @classmethod
    def of(
        cls,
        chosen: str,
        rule: str,
        evaluated: int,
        traits: LogTraits,
        tried: dict[str, Tried],
        complete: bool,
    ) -> Choice:
        """Put a choice among this number of evaluated candidates into words."""
        reason, confidence = _words(chosen, rule, tried[chosen], evaluated, traits, complete)
        advice = _advice(traits, tried, complete)
        return cls(chosen, reason, confidence, advice, complete, traits, tried, rule)

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """Rows of the table of candidates, with the columns `COLUMNS`."""
        return [one.row(name) for name, one in self.tried.items()]

    def write(self, run: Path) -> None:
        """Write `choice.json` of a run; raise TrainingError if it cannot be written."""
        write_json(run / CHOICE_NAME, asdict(self), TrainingError)

    def write_report(self, folder: Path, title: str) -> Path:
        """Write the choice as an HTML page; return its path."""
        traits = asdict(self.traits)
        log = [
            (name.replace("_", " "), _shown(one), _MEANINGS.get(name, ""))
            for name, one in traits.items()
        ]
        stopped = [row for row in self.rows if row[-1] not in FINALISTS]
        finalists = [row for row in self.rows if row[-1] in FINALISTS]
        figures = [Figure.of("Estimates, with 95 % intervals", self._figure())]
        sections = [
            Section("Confidence", self.confidence),
            Section(
                "Finalists",
                EXPLANATION,
                figures if any(one.rating for one in self.tried.values()) else (),
                Table(COLUMNS, finalists),
            ),
            Section("Other candidates", _OTHERS, table=Table(COLUMNS, stopped)),
            Section("The log", table=Table(("", "value", "meaning"), log)),
            Section("How to raise the confidence", " ".join(self.advice)),
        ]
        path = folder / "index.html"
        shown = [each for each in sections if each.table is None or each.table.rows]
        write_page(path, title, self.reason, shown)
        return path

    def _figure(self) -> Any:
        """Draw the estimates of the finalists, and those of the others below them, in gray."""
        rated = [(name, one, one.rating) for name, one in self.tried.items() if one.rating]
        figure, axes = new_figure((4.8, 0.6 + 0.3 * len(rated)))
        for row, (_, one, rating) in enumerate(rated):
            color = COLORS[0] if one.outcome in FINALISTS else PALE
            axes.plot(rating.interval, (row, row), color=color)
            axes.plot(rating.value, row, "o", color=color)
        axes.set_yticks(range(len(rated)), tick_labels(name for name, *_ in rated))
        axes.set_ylim(len(rated) - 0.5, -0.5)
        axes.set_xlabel("estimated discounted return; gray: stopped early")
        return figure


def read_choice(run: Path) -> Choice:
    """Read `choice.json` of a run."""
    try:
        found: Choice = read_json(run / CHOICE_NAME, TrainingError, Choice)
    except FileNotFoundError as error:
        raise TrainingError(f"{run} has no {CHOICE_NAME}: is it a run of `algo='auto'`?") from error
    return found


def _words(
    chosen: str, rule: str, tried: Tried, evaluated: int, traits: LogTraits, complete: bool
) -> tuple[str, str]:
    """Return why the rule chose a candidate, and the confidence in the choice."""
    rating, check = tried.rating, tried.check
    if rating is None:
        reason = f"{chosen} is used because the budget ended before any candidate was evaluated."
        return reason, "Unknown, because no candidate was evaluated."
    count = f"the {counted(evaluated, 'finalist' if complete else 'rated candidate')}"
    confidence = (
        f"In {rating.best_chance:.0%} of the resamplings of episodes, networks and models, {chosen}"
        f" is the best of {count}. This does not include the bias of the models, which a log does"
        " not show."
    )
    if rule == AGREEMENT:
        reason = (
            f"{chosen} takes the logged action in {rating.agreement:.0%} of the states, most often"
            f" of {count}. The behavior is almost deterministic (entropy {traits.entropy:.2f} of"
            " 1), so the log has no evidence that other actions are better."
        )
    elif rule == PRIOR:
        why = "the intervals of the estimates overlap"
        if check is not None and not check.passes:
            why = f"the estimates are not calibrated: {check}"
        reason = (
            f"{chosen} has the best mean score of {count} on other logs, which decides because"
            f" {why}."
        )
    else:
        reason = f"{chosen} has the largest estimated value of {count}: {rating}."
        if check is not None:
            confidence += f" For comparison, {check}."
    return reason, confidence


def _advice(traits: LogTraits, tried: Mapping[str, Tried], complete: bool) -> tuple[str, ...]:
    """Return what data, or which budget, would raise the confidence in the choice."""
    names = [name for name, one in tried.items() if one.outcome in FINALISTS[:2]]
    advice = {
        "Resume with a larger time budget: the budget ended early.": not complete,
        f"Record more episodes: {traits.episodes} are few for an interval.": (
            traits.episodes < _FEW_EPISODES
        ),
        f"Record episodes with 10 to 30 % random actions: only {traits.coverage:.0%} of the"
        " actions are likely in the log, and candidates that take others cannot be evaluated.": (
            traits.coverage < _LOW_COVERAGE
        ),
        "Record behavior_prob, so that weighted estimates can be compared.": (
            not traits.probabilities
        ),
        f"Correct what `mcaprl info` reports: {'; '.join(traits.problems)}.": bool(traits.problems),
        f"Run {' and '.join(names)} in a sim or on the robot, and compare them.": len(names) > 1,
    }
    return tuple(text for text, applies in advice.items() if applies)


def _shown(value: Any) -> str:
    match value:
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.3g}"
        case tuple():
            return "; ".join(value) or "none"
    return str(value)
