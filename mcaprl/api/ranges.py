"""Ranges of the numbers that the functions of the public API accept."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

from mcaprl.errors import UsageError


def check_least(least: int, **numbers: int | None) -> None:
    """Check that numbers are at least `least`; skip numbers that are None.

    >>> check_least(1, episodes=None, envs=0)
    Traceback (most recent call last):
    mcaprl.errors.UsageError: `envs=0`: give a number of at least 1
    """
    for name, number in numbers.items():
        if number is not None and number < least:
            raise UsageError(f"`{name}={number}`: give a number of at least {least}")


def check_fraction(**numbers: float | None) -> None:
    """Check that numbers are from 0 to 1; skip numbers that are None."""
    for name, number in numbers.items():
        if number is not None and not 0 <= number <= 1:
            raise UsageError(f"`{name}={number}`: give a number from 0 to 1")


def check_positive(**numbers: float) -> None:
    """Check that numbers are above 0 and finite."""
    for name, number in numbers.items():
        if not 0 < number < math.inf:
            raise UsageError(f"`{name}={number}`: give a number above 0")


def check_port(port: int) -> None:
    """Check that a port number is valid."""
    if not 0 <= port <= 65535:
        raise UsageError(f"`port={port}`: give a number from 0 to 65535")


@dataclass(frozen=True)
class ClusterOptions:
    """Cluster and workers of a function that can run on Ray.

    Attributes:
        ray: Whether it runs on Ray.
        workers: Number of workers; None for the number of CPUs of the cluster, or with `cuda` its
            number of GPUs.
        address: Address of the cluster; None for RAY_ADDRESS, or else a local cluster.
    """

    ray: bool = True
    workers: int | None = None
    address: str | None = None

    def check(self, **others: int | None) -> None:
        """Check that numbers are at least 1, and that cluster options are given only with `ray`.

        Raises:
            UsageError: An option is given without `ray`, or a number is below 1.
        """
        check_least(1, workers=self.workers, **others)
        given = {"workers": self.workers, "address": self.address, **others}
        for name, value in given.items():
            if value is not None and not self.ray:
                raise UsageError(f"`{name}=` requires `ray=True`")

    def connected(self) -> AbstractContextManager[Any]:
        """Return a context that connects to the cluster, if any; see `ray.cluster`."""
        if not self.ray:
            return nullcontext()
        from mcaprl.ray.cluster import cluster

        return cluster(self.address, workers=self.workers)


# Reprs and pickles contain this public import path.
ClusterOptions.__module__ = "mcaprl"
