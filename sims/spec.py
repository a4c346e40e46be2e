"""Catalog of built-in sims, and of sims that installed packages add by entry points."""

from __future__ import annotations

import functools
import importlib
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import gymnasium as gym

from mcaprl.errors import UsageError
from mcaprl.lazy import installed

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP: Final = "mcaprl.sims"  # Entry point group; each entry point is named after its sim
_installed = functools.cache(functools.partial(installed, GROUP))


@dataclass(frozen=True)
class SimSpec:
    """Description of a sim: its names, environment classes and pilot.

    A package adds a sim to `mcaprl` with an entry point in its `pyproject.toml`. The entry point
    has the sim's short name. It refers to a `SimSpec`, or to a function that returns a `SimSpec`
    and takes no arguments:

        [project.entry-points."mcaprl.sims"]
        boat = "boats.sim:SPEC"
    """

    name: str
    """Short name, as in `mcaprl record NAME`."""
    env_id: str
    """Gymnasium id, as in `boats/Boat-v0`."""
    entry_point: str | Callable[..., gym.Env[Any, Any]]
    """Environment class, or `module:class`."""
    continuous_id: str | None = None
    """Id of the same environment with the argument `actions="continuous"`, if there is one."""
    vector_entry_point: str | None = None
    """`module:class` of the vector environment, if there is one."""
    device_entry_point: str | None = None
    """`module:class` of the `mcaprl.sims.DeviceSims` that keep all vehicles on one device, if there
    are any."""
    max_episode_steps: int | None = None
    """Steps after which an episode is truncated."""
    pilot: str | Callable[[Any], Any] | None = None
    """Class or function, or its `module:name`, that accepts the unwrapped environment and returns
    its scripted policy (`mcaprl.base_policy.BasePolicy`)."""
    engine: str | None = None
    """Module that the sim requires and that the extra `sims` installs."""

    def register(self) -> None:
        """Register the environments with Gymnasium, unless their ids are registered already.

        Gymnasium's passive checker is disabled, because it slows down each step.
        """
        for env_id in self.env_ids:
            if env_id not in gym.registry:
                is_continuous = env_id == self.continuous_id
                gym.register(
                    id=env_id,
                    entry_point=self.entry_point,
                    vector_entry_point=self.vector_entry_point,
                    max_episode_steps=self.max_episode_steps,
                    disable_env_checker=True,
                    kwargs={"actions": "continuous"} if is_continuous else {},
                )

    @property
    def env_ids(self) -> tuple[str, ...]:
        """Gymnasium ids of the sim."""
        return (self.env_id, self.continuous_id) if self.continuous_id else (self.env_id,)

    def make_pilot(self, env: gym.Env[Any, Any]) -> Any:
        """Return the sim's scripted policy for an unwrapped environment; the sim must have one."""
        pilot: Any = self.pilot
        if isinstance(pilot, str):
            module, _, attribute = pilot.partition(":")
            pilot = getattr(importlib.import_module(module), attribute)
        return pilot(env)


class SimCatalog(Mapping[str, str]):
    """Mapping from short names to Gymnasium ids."""

    # Built-in sims are registered with Gymnasium at once; those of other packages are imported when
    # their short name or an unregistered id is looked up.

    def __init__(self, own: Iterable[SimSpec]) -> None:
        """Register the built-in sims."""
        self._specs = {spec.name: spec for spec in own}
        for spec in self._specs.values():
            spec.register()

    def __getitem__(self, name: str) -> str:
        """Return the id of a sim; raise UsageError if its entry point cannot be loaded."""
        return self._spec(name).env_id

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the built-in sims, then over the sims of other packages."""
        return iter([*self._specs, *(name for name in _installed() if name not in self._specs)])

    def __len__(self) -> int:
        """Return the number of sims."""
        return len(list(iter(self)))

    def __contains__(self, name: object) -> bool:
        """Return whether there is a sim of this name, without importing it."""
        return name in self._specs or name in _installed()

    def find(self, env_id: str, *, loads: bool = True) -> SimSpec | None:
        """Return the description of the sim with this id, or None if no sim has it."""
        # `loads` imports the sims of other packages if no registered one has the id; failures warn.
        specs = self._specs
        if loads and all(env_id not in spec.env_ids for spec in specs.values()):
            for name in self:
                try:
                    self._spec(name)
                except UsageError as error:
                    warnings.warn(str(error), stacklevel=2)
        return next((spec for spec in specs.values() if env_id in spec.env_ids), None)

    def _spec(self, name: str) -> SimSpec:
        if name not in self._specs:
            found = _installed()[name]
            spec = _load(found)
            spec.register()
            self._specs[name] = spec
        return self._specs[name]


def _load(found: EntryPoint) -> SimSpec:
    """Load the sim of an entry point."""
    package = f" of package '{found.dist.name}'" if found.dist else ""
    place = f"entry point '{found.name} = {found.value}' in group '{GROUP}'{package}"
    try:
        spec = found.load()
        spec = spec if isinstance(spec, SimSpec) else spec()
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise UsageError(f"{place} cannot be loaded: {reason}") from error
    if not isinstance(spec, SimSpec) or spec.name != found.name:
        raise UsageError(f"{place} must return a SimSpec named '{found.name}', not {spec!r}")
    return spec
