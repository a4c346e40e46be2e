"""What POLICY means on the command line: `pilot`, `random`, or the path of a trained one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym

from mcaprl.errors import PolicyError, UnknownNameError, UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.sims.evaluation.rollout import Policy, check_fit

SCRIPTED = ("pilot", "random")


def policies_of(name: str, env: gym.Env[Any, Any]) -> list[Policy | None]:
    """The policies that a name means in an environment: one, or one per training seed of a run.

    Args:
        name: `pilot`; `random`, which is [None]; or a path.
        env: that they are to act in.

    Raises:
        UnknownNameError: no such policy.
        UsageError: the sim has no pilot.
        PolicyError: the path holds none that fits.
    """
    if name == "random":
        return [None]
    if name == "pilot":
        from mcaprl.sims.evaluation.pilots import make_pilot

        try:
            return [make_pilot(env)]
        except UnknownNameError as error:
            sim = env.spec.id if env.spec else "the environment"
            raise UsageError(
                f"{sim} has no pilot: pass --policy random, or the path of a trained run"
            ) from error
    path = Path(name)
    if not path.exists():
        raise UnknownNameError("policy", name, [*SCRIPTED, *_neighbours(path)])
    loaded: list[Policy | None] = []
    for policy in load_trained(path):
        check_fit(policy, env)
        loaded.append(policy)
    return loaded


def trained_policy(name: str, dataset: Dataset) -> Any:
    """The policy of a run, of its first seed, to be asked about a log; see `trained_policies`."""
    return trained_policies(name, dataset)[0]


def trained_policies(name: str, dataset: Dataset) -> list[Any]:
    """The policies of all seeds of a run, to be asked about a log.

    Raises:
        UsageError: the name is that of a scripted policy.
        UnknownNameError: there is no such path.
        PolicyError: the path holds none, or it was trained on other spaces than the log's.
    """
    if name in SCRIPTED:
        raise UsageError(
            f"{name} has no network to ask about a log: pass the path of a trained run, or --sim"
        )
    path = Path(name)
    if not path.exists():
        raise UnknownNameError("policy", name, ["the path of a trained run", *_neighbours(path)])
    policies = load_trained(path)
    for policy in policies:
        for role in ("observation_space", "action_space"):
            trained, logged = getattr(policy, role), getattr(dataset, role)
            if trained not in (None, logged):
                raise PolicyError(f"{name} was trained on {role} {trained}; the log has {logged}")
    return policies


def policy_names(names: Sequence[str]) -> dict[str, str]:
    """How tables call policies: a path by its last part, or whole where that is another's too."""
    short = {name: name if name in SCRIPTED else Path(name).name for name in names}
    return {
        name: last if list(short.values()).count(last) == 1 else name
        for name, last in short.items()
    }


def is_policy(path: Path) -> bool:
    """Whether a path is a trained policy, and no log."""
    kept = ("best_model.zip", "policy.json")
    return path.suffix == ".zip" or (path.is_dir() and any(any(path.rglob(n)) for n in kept))


def load_trained(path: Path) -> list[Policy]:
    """Load the policies of all seeds of a run, or the one of a file.

    Raises:
        PolicyError: there are none, or a file is broken.
    """
    if path.is_file() or any(path.rglob("best_model.zip")):
        from mcaprl.online.policy import load_policies as load_online

        return list(load_online(path))
    from mcaprl.offline.policy import load_policies

    return list(load_policies(path))


def _neighbours(path: Path) -> list[str]:
    """Folders beside a path that does not exist, which may be what was meant."""
    if not path.parent.is_dir():
        return []
    return [
        str(found) for found in sorted(path.parent.iterdir()) if (found / "config.json").exists()
    ]
