"""Classes that installed packages add by entry points."""

from __future__ import annotations

from collections.abc import Container
from typing import TYPE_CHECKING, Any

from mcaprl.errors import UsageError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


def installed(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name."""
    from importlib.metadata import entry_points

    return {entry.name: entry for entry in entry_points(group=group)}


def load(entry: EntryPoint, base: type[Any], built_in: Container[str]) -> Any:
    """Import the class of an entry point, a subclass of `base`.

    Args:
        entry: Entry point, which has the `name` of its class.
        base: Class that the class is derived from.
        built_in: Names that an entry point cannot have.

    Raises:
        UsageError: The class cannot be imported, has another base or name, or the name is taken.
    """
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
