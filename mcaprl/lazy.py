"""Attributes of a package that are imported on first use."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


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
