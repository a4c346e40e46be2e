"""Options of the commands that can run on a Ray cluster."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any

from mcaprl.api.ranges import check_least
from mcaprl.errors import UsageError


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
