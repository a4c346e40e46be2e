"""Attributes of a package that are imported on first use."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def lazy_attributes(package: str, sources: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """Return a function `__getattr__` that imports a package's public names on first use.

    Args:
        package: Name of the package.
        sources: Dict from the full name of each module to the public names that the module defines.
            If a name equals the last part of the module's name, such as `torch` in `mcaprl.torch`,
            it refers to the module.
    """
    modules = {name: module for module, names in sources.items() for name in names}

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        module = import_module(modules[name])
        value = module if modules[name] == f"{package}.{name}" else getattr(module, name)
        setattr(sys.modules[package], name, value)
        return value

    return get
