"""Attributes of packages and classes of entry points, which are imported on first use."""

from __future__ import annotations

import sys
from collections.abc import Callable, Container, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

from mcaprl.errors import UsageError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


def lazy_attributes(package: str, sources: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """Return a function `__getattr__` that imports a package's public names on first use."""
    modules: dict[str, str] = {}
    attributes: dict[str, str] = {}
    for module, names in sources.items():
        for entry in names:
            attribute, _, alias = entry.partition(" as ")
            modules[alias or attribute], attributes[alias or attribute] = module, attribute

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        module = import_module(modules[name])
        is_module = modules[name] == f"{package}.{name}"
        value = module if is_module else getattr(module, attributes[name])
        setattr(sys.modules[package], name, value)
        return value

    return get


def installed(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name."""
    from importlib.metadata import entry_points

    return {entry.name: entry for entry in entry_points(group=group)}


def load(entry: EntryPoint, base: type[Any], built_in: Container[str]) -> Any:
    """Import the class of an entry point, a subclass of `base` with a name not in `built_in`."""
    try:
        found = entry.load()
    except Exception as error:  # Importing a module can raise any exception.
        raise _broken(entry, f"{type(error).__name__}: {error}") from error
    if not (isinstance(found, type) and issubclass(found, base)):
        raise _broken(entry, f"it is not a subclass of {base.__name__}")
    if (name := getattr(found, "name", None)) != entry.name:
        raise _broken(entry, f"its name is {name!r}")
    if entry.name in built_in:
        raise _broken(entry, "the name is built in")
    return found


def _broken(entry: EntryPoint, reason: str) -> UsageError:
    package = entry.dist.name if entry.dist else "unknown"
    return UsageError(
        f"entry point {entry.name!r} ({entry.value}) of package {package} in group"
        f" {entry.group} is broken: {reason}; fix or uninstall the package"
    )
