"""Outcome of `auto`, stored as `choice.json` of the run: the candidates, the choice, the reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mcaprl.errors import TrainingError
from mcaprl.files import parse_json, read_file, write_json
from mcaprl.offline.estimate.off_policy import LEAST_SAMPLE_SIZE
from mcaprl.offline.selection.portfolio import LogTraits
from mcaprl.offline.selection.rule import Rating
from mcaprl.page import Section, Table, write_page
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
    " FQE; those of candidates that were stopped early are from the first evaluation. best:"
    " fraction of the resamplings in which the candidate is the best in the last evaluation. as"
    " logged: fraction of the states in which the candidate takes the logged action. WPDIS:"
    " estimate by weighted importance sampling, or the effective number of episodes if there are"
    " too few."
)
STOPPED_EARLY: Final = "stopped early"
"""Outcome of a candidate that was not trained with all updates, or cannot be chosen."""
_FEW_EPISODES: Final = 50
_LOW_COVERAGE: Final = 0.5
_NO_VALUE: Final = "-"


@dataclass(frozen=True)
class Tried:
    """Results of one candidate.

    Attributes:
        updates: Number of updates at the last evaluation of the candidate. If there was no
            evaluation, the current number of updates.
        rating: Its estimate; None if it was not evaluated.
        support: Fraction of the states in which its action is likely under the behavior policy.
        bellman_error: Its relative Bellman error; None if it has no Q-values.
        weighted: Estimate by WPDIS, and the effective number of episodes of this estimate; None
            if the log has no action probabilities.
        outcome: `chosen`, `runner-up`, `stopped early`, or why it was not trained.
    """

    updates: int = 0
    rating: Rating | None = None
    support: float | None = None
    bellman_error: float | None = None
    weighted: tuple[float, float] | None = None
    outcome: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the attributes as plain JSON types."""
        rating = self.rating.to_json() if self.rating else None
        return {
            **vars(self),
            "rating": rating,
            "weighted": self.weighted and list(self.weighted),
        }

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Tried:
        """Return the candidate that `to_json` returned."""
        rating, weighted = found["rating"], found["weighted"]
        if rating is not None:
            rating = Rating(**{**rating, "interval": tuple(rating["interval"])})
        return cls(**{**found, "rating": rating, "weighted": weighted and tuple(weighted)})


@dataclass(frozen=True)
class Choice:
    """Policy that `auto` chose, and the reason.

    Attributes:
        chosen: Name of the candidate.
        reason: Why it was chosen, in words.
        confidence: Confidence in the choice, in words.
        advice: What data would raise this confidence, in words.
        complete: Whether all planned training and evaluation was done within the budget.
        traits: Properties of the log.
        tried: What is known of each candidate, by name, from the best to the worst.
    """

    chosen: str
    reason: str
    confidence: str
    advice: tuple[str, ...]
    complete: bool
    traits: LogTraits
    tried: dict[str, Tried]

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """Rows of the table of candidates, with the columns `COLUMNS`."""
        return [_row(name, one) for name, one in self.tried.items()]

    def write(self, run: Path) -> None:
        """Write `choice.json` of a run.

        Raises:
            TrainingError: The file cannot be written.
        """
        found = {
            "chosen": self.chosen,
            "reason": self.reason,
            "confidence": self.confidence,
            "advice": list(self.advice),
            "complete": self.complete,
            "traits": self.traits.to_json(),
            "tried": {name: one.to_json() for name, one in self.tried.items()},
        }
        write_json(run / CHOICE_NAME, found, TrainingError)

    def write_report(self, folder: Path, title: str) -> Path:
        """Write the choice as an HTML page; return its path.

        Raises:
            MissingExtraError: Jinja2 is not installed.
            ReportError: The page cannot be written.
        """
        log = [(name.replace("_", " "), _shown(value)) for name, value in _shown_traits(self)]
        sections = [
            Section("Confidence", self.confidence),
            Section("Candidates", EXPLANATION, table=Table(COLUMNS, self.rows)),
            Section("The log", table=Table(("", ""), log)),
            Section("How to raise the confidence", " ".join(self.advice)),
        ]
        path = folder / "index.html"
        write_page(path, title, self.reason, sections)
        return path


def read_choice(run: Path) -> Choice:
    """Read `choice.json` of a run.

    Raises:
        TrainingError: The run has no such file, or the file is broken.
    """
    path = run / CHOICE_NAME
    try:
        found = parse_json(read_file(path))
        traits = LogTraits(**{**found["traits"], "problems": tuple(found["traits"]["problems"])})
        tried = {name: Tried.from_json(one) for name, one in found["tried"].items()}
        return Choice(
            found["chosen"],
            found["reason"],
            found["confidence"],
            tuple(found["advice"]),
            found["complete"],
            traits,
            tried,
        )
    except FileNotFoundError as error:
        raise TrainingError(f"{run} has no {CHOICE_NAME}: is it a run of --algo auto?") from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise TrainingError(f"{path} cannot be read: {error}") from error


def reason_of(chosen: str, ratings: Mapping[str, Rating], traits: LogTraits) -> str:
    """Return why the rule chose a candidate, in words."""
    if chosen not in ratings:
        return f"{chosen} is used because the budget ended before any candidate was evaluated."
    mine, count = ratings[chosen], counted(len(ratings), "candidate")
    if traits.is_deterministic:
        return (
            f"{chosen} takes the logged action in {mine.agreement:.0%} of the states, most often of"
            f" {count}. The behavior is almost deterministic (entropy {traits.entropy:.2f} of 1),"
            " so the log has no evidence that other actions are better."
        )
    return f"{chosen} has the largest estimated value of {count}: {_with_interval(mine)}."


def confidence_of(chosen: str, ratings: Mapping[str, Rating]) -> str:
    """Return the confidence in a choice, in words."""
    if chosen not in ratings:
        return "Unknown, because no candidate was evaluated."
    chance = ratings[chosen].best_chance
    return (
        f"In {chance:.0%} of the resamplings of episodes, networks and models, {chosen}"
        f" is the best of {counted(len(ratings), 'candidate')}. This does not include the bias"
        " of the models, which a log does not show."
    )


def advice_for(traits: LogTraits, tried: Mapping[str, Tried], complete: bool) -> tuple[str, ...]:
    """Return what data, or which budget, would raise the confidence in the choice."""
    advice = []
    if not complete:
        advice.append("Resume with a larger --budget-minutes: the budget ended early.")
    if traits.episodes < _FEW_EPISODES:
        advice.append(f"Record more episodes: {traits.episodes} are few for an interval.")
    if traits.coverage < _LOW_COVERAGE:
        advice.append(
            f"Record episodes with 10 to 30 % random actions: only {traits.coverage:.0%} of the"
            " actions are likely in the log, and candidates that take others cannot be evaluated."
        )
    if not traits.probabilities:
        advice.append("Record behavior_prob, so that weighted estimates can be compared.")
    if traits.problems:
        advice.append(f"Correct what `mcaprl info` reports: {'; '.join(traits.problems)}.")
    names = [name for name, one in tried.items() if one.outcome in ("chosen", "runner-up")]
    if len(names) > 1:
        advice.append(f"Run {names[0]} and {names[1]} in a sim or on the robot, and compare them.")
    return tuple(advice)


def _row(name: str, one: Tried) -> tuple[str, ...]:
    rating = one.rating
    # Candidates that were stopped early do not take part in the last evaluation.
    chance = rating.best_chance if rating and one.outcome != STOPPED_EARLY else None
    return (
        name,
        str(one.updates),
        _with_interval(rating) if rating else _NO_VALUE,
        _NO_VALUE if chance is None else f"{chance:.0%}",
        f"{rating.agreement:.0%}" if rating else _NO_VALUE,
        _NO_VALUE if one.bellman_error is None else f"{one.bellman_error:.2f}",
        _weighted(one.weighted),
        one.outcome,
    )


def _with_interval(rating: Rating) -> str:
    low, high = rating.interval
    return f"{rating.value:.4g} ({low:.4g} to {high:.4g})"


def _weighted(found: tuple[float, float] | None) -> str:
    if found is None:
        return _NO_VALUE
    value, size = found
    return f"{value:.4g}" if size >= LEAST_SAMPLE_SIZE else f"refused ({size:.1f})"


def _shown_traits(choice: Choice) -> list[tuple[str, Any]]:
    return list(choice.traits.to_json().items())


def _shown(value: Any) -> str:
    match value:
        case bool():
            return "yes" if value else "no"
        case float():
            return f"{value:.3g}"
        case list():
            return "; ".join(value) or "none"
    return str(value)
