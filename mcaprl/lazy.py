"""Attributes of a package that are imported on first use."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_attributes(package: str, sources: Mapping[str, str]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package that imports its public names on first use.

    Args:
        package: Name of the package.
        sources: `module` or `module:name` in which each public name is defined.
    """

    def get(name: str) -> Any:
        if name not in sources:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        module, _, defined = sources[name].partition(":")
        value = getattr(import_module(module), defined or name)
        setattr(sys.modules[package], name, value)
        return value

    return get
