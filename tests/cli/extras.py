"""Packages that the extras of this package install, by the names with which they are imported."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from functools import cache
from importlib.metadata import packages_distributions

from tests.support.paths import ROOT

_PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
_EXTRAS: dict[str, list[str]] = _PROJECT["optional-dependencies"]
# Names of imports that differ from that of the distribution, which may not be installed.
_IMPORTS = {
    "pillow": "PIL",
    "pygame_ce": "pygame",
    "foxglove_sdk": "foxglove",
    "protobuf": "google",
}


def imports_of(extras: Iterable[str]) -> set[str]:
    """Return the names of the packages of some extras, and of what these extras contain."""
    found: set[str] = set()
    for extra in extras:
        for requirement in _EXTRAS[extra]:
            own = re.match(r"mcaprl\[(.*)\]", requirement)
            found |= imports_of(own[1].split(",")) if own else {_import_name(requirement)}
    return found


def imports_of_base() -> set[str]:
    """Return the names of the packages that are installed without extras."""
    return set(map(_import_name, _PROJECT["dependencies"]))


def packages_of_extras() -> set[str]:
    """Return the names of the packages that only extras install."""
    return imports_of(_EXTRAS) - imports_of_base()


def _import_name(requirement: str) -> str:
    match = re.match(r"[A-Za-z0-9._-]+", requirement)
    assert match is not None
    name = re.sub(r"[-.]+", "_", match[0]).lower()
    return _IMPORTS.get(name) or _modules().get(name, name)


@cache
def _modules() -> dict[str, str]:
    """Return the module of each installed distribution that has a single public one."""
    modules: dict[str, list[str]] = {}
    for module, distributions in packages_distributions().items():
        for distribution in distributions:
            if not module.startswith("_"):
                modules.setdefault(re.sub(r"[-.]+", "_", distribution).lower(), []).append(module)
    return {name: found[0] for name, found in modules.items() if len(found) == 1}
