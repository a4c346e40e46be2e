"""Policies by name (`pilot`, `random`, or the path of a trained policy), and their export."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import gymnasium as gym
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.base_policy import BasePolicy, RandomPolicy, as_policy
from mcaprl.errors import McaprlError, PolicyError, UnknownNameError, UsageError
from mcaprl.files import check_target
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.record.recordable import RecordedSpace, recorded_like
from mcaprl.runs import BEST_NAME, CONFIG_NAME, POLICY_NAME, RunSummary, policy_files
from mcaprl.sims.evaluation.rollout import check_fit, same_form

if TYPE_CHECKING:
    from mcaprl.offline.policy import Policy

SCRIPTED = ("pilot", "random")
Names = str | PathLike[str] | Sequence[str | PathLike[str]]
"""`pilot`, `random` or the path of a policy, or several of them; a `Run` is a path."""
Summary = TypeVar("Summary", bound=RunSummary)


class Run(list[Summary]):
    """Trained run: the list of the summaries of its seeds, with its folder and its policies.

    Attributes:
        folder: Run folder.
    """

    def __init__(self, folder: Path, summaries: Iterable[Summary]) -> None:
        """Store the folder and one summary for each seed."""
        super().__init__(summaries)
        self.folder = folder

    def __fspath__(self) -> str:
        """Return the path of the folder, so that functions accept a run as a path."""
        return str(self.folder)

    @property
    def summaries(self) -> list[Summary]:
        """One summary for each seed."""
        return list(self)

    @cached_property
    def policy(self) -> Policy:
        """Policy of the first seed, as `load_policy` returns it; it is loaded on first use."""
        return load_policy(self.folder)

    @cached_property
    def policies(self) -> list[Policy]:
        """Policies of all seeds."""
        return load_policies(self.folder)


def as_names(policies: Names) -> list[str]:
    """Return the names of one or more policies.

    >>> as_names("random"), as_names(["pilot", Path("runs/cql")])
    (['random'], ['pilot', 'runs/cql'])
    """
    return [_name(policies)] if isinstance(policies, str | PathLike) else list(map(_name, policies))


def _name(path: str | PathLike[str]) -> str:
    return str(path.folder if isinstance(path, Run) else path)


def by_name(policies: Any) -> dict[str, str | BasePolicy]:
    """Return the names and objects of one or more policies, by names for tables.

    >>> by_name("runs/cql"), list(by_name([RandomPolicy(None), RandomPolicy(None), "pilot"]))
    ({'runs/cql': 'runs/cql'}, ['random-2', 'random-3', 'pilot'])
    """
    is_one = isinstance(policies, str | PathLike) or hasattr(policies, "act")
    found: dict[str, str | BasePolicy] = {}
    for one in [policies] if is_one or not isinstance(policies, Iterable) else policies:
        if isinstance(one, str | PathLike):
            found[_name(one)] = _name(one)
            continue
        policy = as_policy(one, is_deterministic=False)
        names = itertools.chain([policy.name], (f"{policy.name}-{n}" for n in itertools.count(2)))
        found[next(name for name in names if name not in {*found, *SCRIPTED})] = policy
    return found


def load_policy(path: str | PathLike[str]) -> Policy:
    """Load a trained policy, without unpickling or executing anything in its files.

    Args:
        path: Run folder (its first seed is loaded), folder of one seed (`RUN/seed-2`), or `.zip`
            file of Stable-Baselines3.

    Raises:
        PolicyError: The path does not exist or contains no policy, or a file is broken.
        MissingExtraError: The packages of the `offline` or `online` extra are not installed.
    """
    return _load(_found_files(Path(path))[0])


def load_policies(path: str | PathLike[str]) -> list[Policy]:
    """Load the policies of all seeds of a run, sorted by seed; see `load_policy`."""
    return [_load(file) for file in _found_files(Path(path))]


def export(
    run: str | PathLike[str],
    out: str | Path | None = None,
    *,
    node: str | Path | None = None,
    overwrite: bool = False,
) -> Policy:
    """Write a trained policy as ONNX, or as a node of ROS 2, which run without this package.

    The inputs are the parts of an observation, with the same names as in the log. The outputs are
    `action` and `scores`.

    Args:
        run: Run folder, folder of one seed, or `.zip` file of Stable-Baselines3.
        out: ONNX file to write.
        node: Python file to write: a program of rclpy that drives the robot from whose bag the
            policy was trained, as `Driver` does. It contains the policy, and needs ONNX Runtime and
            NumPy.
        overwrite: Whether existing files are replaced.

    Returns:
        The policy that was exported.

    Raises:
        OutputExistsError: A file exists.
        PolicyError: There is no policy, or it cannot be exported.
        UsageError: No file is given, or a node cannot drive by the mapping of the run.
        MissingExtraError: The packages of the `export` extra are not installed.
    """
    from mcaprl.offline.export import export_onnx

    files = [Path(each) for each in (out, node) if each is not None]
    if not files:
        raise UsageError("pass `out`, `node`, or both")
    for file in files:
        check_target(file, overwrite=overwrite)
    policy = load_policy(run)
    if node is not None:
        from mcaprl.drive.driver import Driver
        from mcaprl.drive.node import export_node

        export_node(Driver(run), Path(node), overwrite=overwrite)
    if out is not None:
        export_onnx(policy, Path(out), overwrite=overwrite)
    return policy


def policies_of(name: str | BasePolicy, env: gym.Env[Any, Any]) -> list[BasePolicy]:
    """Return the policies of a name; a run has one policy per training seed."""
    if isinstance(name, BasePolicy):
        return [_fitted(name, env)]
    if name == "random":
        return [RandomPolicy(env.action_space)]
    if name == "pilot":
        from mcaprl.sims.evaluation.evaluate import has_pilot, make_pilot

        if not has_pilot(env):
            sim = env.spec.id if env.spec else "the environment"
            raise UsageError(f"{sim} has no pilot: use random, or the path of a trained run")
        return [make_pilot(env)]
    policies = load_policies(_existing(name, SCRIPTED))
    return [_fitted(policy, env) for policy in policies]


class _PartPolicy(BasePolicy):
    """A policy that receives observations in the form of the log that it was trained on."""

    def __init__(self, policy: BasePolicy, recorded: RecordedSpace) -> None:
        self.name, self.begin = policy.name, policy.begin  # type: ignore[method-assign]
        self._policy, self._recorded = policy, recorded

    def act(self, observations: Any) -> NDArray[Any]:
        return self._policy.act(self._recorded.of(observations))


def _fitted(policy: BasePolicy, env: gym.Env[Any, Any]) -> BasePolicy:
    """Return a policy that acts in `env`, which may have more observations, or a Tuple."""
    space = policy.observation_space
    if isinstance(space, spaces.Dict) and not same_form(space, env.observation_space):
        with suppress(McaprlError):
            recorded = recorded_like(env.observation_space, space)
            check_fit(policy, env, recorded.space)
            return _PartPolicy(policy, recorded)
    check_fit(policy, env)
    return policy


def trained_policies(name: str, dataset: Dataset) -> list[Policy]:
    """Load the policies of all seeds of a run, and check that they fit a log."""
    if name in SCRIPTED:
        raise UsageError(
            f"{name} has no network to evaluate on a log: pass the path of a trained run"
        )
    policies = load_policies(_existing(name, ["the path of a trained run"]))
    for policy in policies:
        for role in ("observation_space", "action_space"):
            trained, logged = getattr(policy, role), getattr(dataset, role)
            if trained is not None and not same_form(trained, logged):
                hint = ""
                if role == "observation_space" and (source := policy.mask_from):
                    hint = f'; open it and pass with_action_mask("{source}")'
                raise PolicyError(
                    f"{name} was trained on {role} {trained}; the log has {logged}{hint}"
                )
    return policies


def policy_names(names: Sequence[str]) -> dict[str, str]:
    """Return names for tables: the last part of each path, or the whole path if two are equal.

    >>> policy_names(["random", "a/run", "b/run", "b/other"])
    {'random': 'random', 'a/run': 'a/run', 'b/run': 'b/run', 'b/other': 'other'}
    """
    short = {name: name if name in SCRIPTED else Path(name).name for name in names}
    return {
        name: last if list(short.values()).count(last) == 1 else name
        for name, last in short.items()
    }


def is_policy(path: Path) -> bool:
    """Return whether a path is a trained policy rather than a log."""
    return path.suffix == ".zip" or (path.is_dir() and bool(policy_files(path)))


def _existing(name: str, others: Sequence[str]) -> Path:
    """Return the path of a policy; if it does not exist, raise an error that lists nearby runs."""
    path = Path(name)
    if path.exists():
        return path
    folders = sorted(path.parent.iterdir()) if path.parent.is_dir() else []
    runs = [str(folder) for folder in folders if (folder / CONFIG_NAME).exists()]
    if path.parent != Path():
        near = difflib.get_close_matches(name, runs, n=1, cutoff=0.5)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise UsageError(f"{name}: no such file or folder{hint}")
    raise UnknownNameError("policy", name, [*others, *runs])


def _found_files(path: Path) -> list[Path]:
    if not path.exists():
        raise PolicyError(f"{path}: no such file or folder")
    if path.suffix == ".mcap":
        raise PolicyError(f"{path} is a log: pass the path of a trained run, or a .zip file of SB3")
    files = policy_files(path)
    if not files:
        raise PolicyError(
            f"{path} has no policy: it contains no {POLICY_NAME}, no {BEST_NAME}, and no seed-K"
            " folder with a policy; training writes the policy with its first checkpoint"
        )
    return files


def _load(file: Path) -> Policy:
    if file.name == POLICY_NAME:
        from mcaprl.offline.policy import read_policy

        return read_policy(file.parent)
    from mcaprl.online.zip_file import read_policy as read_model

    return read_model(file)
