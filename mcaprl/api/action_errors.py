"""Action errors of any policy in the states of a log: `evaluate --data`."""

from __future__ import annotations

import copy
import importlib
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from mcaprl.api.policies import is_policy, policy_names, trained_policies
from mcaprl.api.ranges import check_least
from mcaprl.base_policy import BasePolicy, RandomPolicy, as_policy
from mcaprl.errors import McaprlError, PolicyError, UsageError, import_extra
from mcaprl.files import check_regular
from mcaprl.frames import rows_of, stacked_frames
from mcaprl.page import COLORS, PAGE_NAME, Figure, Panel, Section, Table, write_page
from mcaprl.recorder.format.spaces import observation_leaves
from mcaprl.recorder.source import Data, named, opened
from mcaprl.runs import CONFIG_NAME, read_config
from mcaprl.texts import counted, shortened

if TYPE_CHECKING:
    from mcaprl.offline.estimate.action_error import ActionError, Actor
    from mcaprl.recorder.dataset.dataset import Dataset
    from mcaprl.recorder.dataset.transitions import Episode

CAVEAT: Final = (
    "Action error is not success: a policy with a small error can still leave the logged states and"
    " fail, and one with a large error can succeed in another way."
)
_FUNCTION = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
_EPISODE = re.compile(r"episode-(\d{1,9})\.npy")
_MAX_BYTES: Final = 2**31
_SHOWN_PARTS: Final = 6
_SHOWN_UNIT: Final = 30


@dataclass(frozen=True)
class ActionErrors:
    """Action errors of policies in the states of one log.

    Attributes:
        data: Names of the logs.
        policies: Errors of each policy.
    """

    data: str
    policies: tuple[ActionError, ...]

    @property
    def caveat(self) -> str:
        """What the errors do not show."""
        return CAVEAT

    def to_json(self) -> dict[str, Any]:
        """Return what `evaluate --data --json` prints as `action_errors`."""
        return {
            "data": self.data,
            "caveat": CAVEAT,
            "policies": [one.to_json() for one in self.policies],
        }

    def rows(self, found: ActionError) -> tuple[list[str], list[list[str]]]:
        """Return the columns and the cells of a policy's table."""
        several = found.horizon > 1
        columns = ["part", "error", "95 % interval", *found.total.baselines]
        columns += [f"at step {found.horizon}"] if several else []
        columns += ["change a step", "log's"]
        cells = []
        for one in (found.total, *found.parts) if len(found.parts) > 1 else found.parts:
            numbers = [one.mean, *one.baselines.values()]
            shown = [f"{number:.3g}" for number in numbers]
            interval = "" if one.interval is None else "{:.3g} to {:.3g}".format(*one.interval)
            shown.insert(1, interval)
            shown += [f"{one.by_horizon[-1]:.3g}"] if several else []
            unit = f" ({one.unit})" if one.unit else ""
            row = [one.part + unit, *shown, f"{one.change:.3g}", f"{one.logged_change:.3g}"]
            cells.append(row)
        return columns, cells


def action_errors(
    policies: Any,
    data: Data,
    *,
    trust_code: bool = False,
    seed: int = 1_000_000,
    threads: int = 1,
    report: str | Path | None = None,
) -> ActionErrors:
    """Compare the actions of policies with the logged ones, beside three baselines.

    The episodes are those that a run held out of its training on this log, otherwise all. At most
    10,000 steps are compared. See `mcaprl.offline.estimate.action_error` for what is computed.

    Args:
        policies: One or more of: `random`; path of a trained run or of a `.zip` file of
            Stable-Baselines3; path of an ONNX file, whose inputs are named like the parts of an
            observation; `module:function`, of an observation, which returns an action or a chunk
            (H, *shape); a folder with `episode-K.npy`, the actions (T, *shape) or chunks
            (T, H, *shape) of episode K of the data; or an object with `act`.
        data: Dataset, file, folder or glob of logs, or several of them.
        trust_code: Whether `module:function` is imported.
        seed: Seed of the drawn episodes, of `random`, and of the resampling.
        threads: Number of threads of the reader.
        report: Output folder of the HTML report.

    Raises:
        UsageError: `module:function` is not trusted or cannot be imported.
        UnknownNameError: There is no such policy.
        PolicyError: A policy fits another space, fails, or returns other shapes.
        LogError: The logs cannot be read.
    """
    from mcaprl.offline.estimate.action_error import compare

    check_least(0, seed=seed)
    if report is not None:
        import_extra("matplotlib", "report")
        import_extra("jinja2", "report")
    dataset = opened(data, threads=threads)
    actors = actors_of(policies, dataset, trust_code=trust_code, seed=seed)
    found = ActionErrors(named(data), tuple(compare(dataset, actor, seed) for actor in actors))
    if report is not None:
        _write_report(Path(report) / PAGE_NAME, found)
    return found


def is_estimable(policy: str, data: Dataset) -> bool:
    """Return whether `mcaprl.estimate` can evaluate a policy: its actions depend on the state."""
    if policy == "random":
        return True
    if is_foreign(policy):
        return False
    loaded = trained_policies(policy, data) if is_policy(Path(policy)) else []
    # A missing path is reported by `estimate`.
    return not any(one.chunk.has_memory for one in loaded if hasattr(one, "chunk"))


def is_foreign(name: str) -> bool:
    """Return whether a name is an ONNX file, a function, or a folder of predictions."""
    path = Path(name)
    if path.exists():
        return path.suffix == ".onnx" or (path.is_dir() and bool(_predictions_in(path)))
    return _FUNCTION.fullmatch(name) is not None


def actors_of(policies: Any, dataset: Dataset, *, trust_code: bool, seed: int = 0) -> list[Actor]:
    """Return what `action_errors` compares."""
    is_one = isinstance(policies, str | Path) or not isinstance(policies, Sequence)
    found: list[Actor] = []
    given = [policies] if is_one or hasattr(policies, "__fspath__") else policies
    names = [str(getattr(one, "folder", one)) for one in given]
    shown = policy_names(names)
    for one, name in zip(given, names, strict=True):
        if hasattr(one, "act"):
            policy = as_policy(one)
            found.append(_of_policy(policy, policy.name))
        elif name == "random":
            space = copy.deepcopy(dataset.action_space)
            space.seed(seed)
            found.append(_of_policy(RandomPolicy(space), name))
        elif not is_foreign(name):
            loaded = trained_policies(name, dataset)
            split = _split_of(Path(name), dataset)
            for policy in loaded:
                label = policy.name if len(loaded) > 1 else shown[name]
                found.append(_of_policy(policy, label, **split))
        elif Path(name).is_dir():
            found.append(_of_predictions(Path(name), dataset))
        elif Path(name).exists():
            found.append(_of_function(_OnnxModel(Path(name), dataset), shown[name]))
        else:
            found.append(_of_function(_imported(name, trust_code), name))
    return found


def _split_of(path: Path, dataset: Dataset) -> dict[str, Any]:
    """Return the episodes that a run held out, if it was trained on this data."""
    from mcaprl.offline.training.watch import choose_held_out

    config: dict[str, Any] = {}
    for folder in (path, path.parent):
        if (folder / CONFIG_NAME).is_file():
            with suppress(McaprlError):
                config = read_config(folder)
            break
    match config:
        case {"data": str(data), "config": {"held_out": float(share) | int(share)}}:
            wholes = dataset.wholes
            if data != dataset.fingerprint:
                match config.get("source"):
                    case {"data": dataset.content, "episodes": list(episodes)} if {*episodes} <= {
                        *wholes.tolist()
                    }:
                        wholes = np.array(episodes, np.int64)
                    case {"data": dataset.content}:
                        pass
                    case _:
                        return {"why": "all episodes; the run was trained on other data"}
            is_held_out = np.isin(np.arange(len(wholes)), choose_held_out(wholes, share))
            held_out, rest = (
                np.flatnonzero(np.isin(dataset.wholes, wholes[rows])).tolist()
                for rows in (is_held_out, ~is_held_out)
            )
            if held_out:
                return {"compared": held_out, "trained_on": rest, "why": "held out of the training"}
            return {"why": "all episodes, which the run was trained on: it held none out"}
    return {}


def _of_policy(policy: BasePolicy, name: str, **split: Any) -> Actor:
    from mcaprl.offline.estimate.action_error import Actor
    from mcaprl.offline.estimate.values import by_rows

    has_chunks = policy.chunk.length > 1

    def inputs(episode: Episode) -> Any:
        return stacked_frames(episode.observations, policy.frame_stack)

    def actions(episode: Episode) -> Any:
        policy.begin()
        return by_rows(policy.act_chunk if has_chunks else policy.act, inputs(episode))

    def call(episode: Episode, step: int) -> Any:
        if step == 0:
            policy.begin()
        return policy.act(rows_of(episode.observations, slice(step, step + 1)))

    def log_probs(episode: Episode) -> Any:
        return policy.log_prob(inputs(episode), episode.actions)

    return Actor(name, actions, call, log_probs, **split)


def _of_function(function: Callable[[Any], Any], name: str) -> Actor:
    """Compare a function of one observation."""
    from mcaprl.offline.estimate.action_error import Actor

    def call(episode: Episode, step: int) -> Any:
        if step == 0 and isinstance(function, _OnnxModel):
            function.begin()
        try:
            return function(rows_of(episode.observations, step))
        except McaprlError:
            raise
        # Code of the user can raise anything.
        except Exception as error:
            raise PolicyError(
                f"{name} fails at episode {episode.index} step {step}:"
                f" {type(error).__name__}: {error}"
            ) from error

    def actions(episode: Episode) -> list[Any]:
        return [call(episode, step) for step in range(len(episode))]

    return Actor(name, actions, call)


def _imported(name: str, trust_code: bool) -> Callable[[Any], Any]:
    if not trust_code:
        raise UsageError(
            f"the policy '{name}' is Python code: pass `trust_code=True` if you trust it"
        )
    module, _, function = name.partition(":")
    try:
        found: Callable[[Any], Any] = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"the policy '{name}' cannot be imported: {error}") from error
    return found


class _OnnxModel:
    """Function of one observation, which runs an ONNX file."""

    def __init__(self, path: Path, dataset: Dataset) -> None:
        runtime = import_extra("onnxruntime", "export")
        check_regular(path)
        options = runtime.SessionOptions()
        options.intra_op_num_threads = 1
        self._path = path
        self._seen: dict[str, list[NDArray[Any]]] = {}
        try:
            self._session = runtime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        # ONNX Runtime has no common class of its errors.
        except Exception as error:
            line = str(error).splitlines()[0]
            raise PolicyError(f"{path} is not an ONNX model that can be run: {line}") from error
        leaves = {leaf.name: leaf for leaf in observation_leaves(dataset.observation_space)}
        inputs = self._session.get_inputs()
        if len(inputs) == len(leaves) == 1:
            leaves = {inputs[0].name: next(iter(leaves.values()))}
        if missing := [one.name for one in inputs if one.name not in leaves]:
            raise PolicyError(
                f"{path} has the input '{missing[0]}', but an observation has: {', '.join(leaves)}"
            )
        self._inputs = [(one, leaves[one.name]) for one in inputs]
        outputs = [one.name for one in self._session.get_outputs()]
        self._output = "action" if "action" in outputs else outputs[0]

    def begin(self) -> None:
        """Drop the frames of the episode before."""
        self._seen = {}

    def __call__(self, observation: Any) -> NDArray[Any]:
        """Return the action, or a chunk of actions; an input with one more axis gets a stack."""
        fed = {}
        for one, leaf in self._inputs:
            value = np.asarray(leaf.of(observation))
            if len(one.shape) == value.ndim + 2 and isinstance(one.shape[1], int):
                seen = self._seen.setdefault(one.name, [value] * one.shape[1])
                seen[:] = [*seen[1:], value]
                value = np.stack(seen)
            dtype = {"tensor(float)": np.float32, "tensor(double)": np.float64}.get(one.type)
            fed[one.name] = value[None] if dtype is None else value[None].astype(dtype)
        try:
            found: NDArray[Any] = self._session.run([self._output], fed)[0][0]
        except Exception as error:
            line = str(error).splitlines()[0]
            raise PolicyError(f"{self._path} does not fit the observations: {line}") from error
        return found


def _predictions_in(folder: Path) -> dict[int, Path]:
    matches = ((_EPISODE.fullmatch(path.name), path) for path in folder.iterdir())
    return {int(match[1]): path for match, path in matches if match}


def _of_predictions(folder: Path, dataset: Dataset) -> Actor:
    """Compare actions that were computed elsewhere."""
    from mcaprl.offline.estimate.action_error import Actor

    files = _predictions_in(folder)
    count = len(dataset.episodes)
    for number in files:
        if number >= count:
            episodes = counted(count, "episode")
            raise PolicyError(f"{files[number]}: the data has no episode {number}, but {episodes}")
    why = "all episodes" if len(files) == count else f"those in the folder, of {count}"
    return Actor(
        folder.name, lambda episode: _read(files[episode.index]), compared=sorted(files), why=why
    )


def _read(path: Path) -> NDArray[Any]:
    try:
        check_regular(path)
        # Nothing is unpickled; the size in the header is checked before the numbers are read.
        array = np.load(path, mmap_mode="r", allow_pickle=False)
        if array.nbytes > _MAX_BYTES:
            raise PolicyError(f"{path} is larger than 2 GiB: write fewer actions per chunk")
        return np.array(array)
    except (OSError, ValueError, EOFError) as error:
        raise PolicyError(f"{path} cannot be read as an array of numbers: {error}") from error


def _write_report(path: Path, found: ActionErrors) -> None:
    sections = []
    for one in found.policies:
        columns, rows = found.rows(one)
        episode = one.worst.window_episode
        caption = f"{{}}: the worst ten seconds, episode {episode}"
        figures = [
            Figure.of(caption.format(part.part), Panel("", partial(_window, one, k)).figure())
            for k, part in enumerate(one.parts[:_SHOWN_PARTS])
        ]
        if one.horizon > 1:
            panel = Panel("", partial(_by_horizon, one))
            figures.insert(0, Figure.of("Error by step of the chunk", panel.figure()))
        text = f"{counted(one.episodes, 'episode')} ({one.why}), {counted(one.steps, 'step')}."
        sections.append(
            Section(
                one.policy, f"{text} {'. '.join(_sentence(line) for line in one.lines())}.", figures
            )
        )
        sections.append(Section("", table=Table(columns, rows)))
    write_page(path, f"Action errors in {found.data}", CAVEAT, sections)


def _sentence(line: str) -> str:
    return line[:1].upper() + line[1:]


def _window(one: ActionError, part: int, axes: Any) -> None:
    times, own, logged = one.window
    for rows, color, label in ((logged, COLORS[0], "log"), (own, COLORS[1], "policy")):
        axes.step(times, rows[:, part], where="post", color=color, label=label, lw=1.3)
    axes.set_xlabel("time since the start of the episode (s)")
    # Names of both ends of a part are longer than the axis.
    axes.set_ylabel(shortened(one.parts[part].unit, _SHOWN_UNIT))
    axes.legend(loc="best")


def _by_horizon(one: ActionError, axes: Any) -> None:
    steps = np.arange(1, one.horizon + 1)
    if all(interval is not None for interval in one.total.horizon_intervals):
        low, high = np.array(one.total.horizon_intervals, np.float64).T
        axes.fill_between(steps, low, high, color=COLORS[0], alpha=0.2, lw=0)
    axes.plot(steps, one.total.by_horizon, color=COLORS[0])
    axes.set_xlabel("step of the chunk")
    axes.set_ylabel(f"error of all parts {one.total.unit}")
