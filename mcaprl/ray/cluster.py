"""Connection to a Ray cluster, or to a local cluster that only this process uses."""

from __future__ import annotations

import logging
import os
import secrets
import signal
import socket
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from mcaprl.errors import ClusterError, UsageError, import_extra

LOCAL: Final = "local"
_CONNECT_S = 5.0
# File in which `ray start` writes the address of this machine's cluster.
_CURRENT: Final = Path("/tmp/ray/ray_current_cluster")
_MIB = 1 << 20
# Size of the object store of a local cluster that transfers only requests and results.
SMALL_STORE_BYTES: Final = 100 * _MIB
# Ray listens on every network interface unless this variable is 0 before Ray is imported.
_LOOPBACK = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
# Signals whose handlers Ray Tune replaces. Windows has no SIGUSR1.
_REPLACED: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGUSR1") if hasattr(signal, name)
)
_TOKENS = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


def local_settings() -> dict[str, str]:
    """Return the environment variables for a local cluster. Ray reads them when it is imported."""
    # Other users can reach the loopback interface, but only processes with the token connect.
    return {
        _LOOPBACK: "0",
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
        "RAY_USAGE_STATS_ENABLED": "0",
        # By default, tasks that need too much memory are repeated without end.
        "RAY_task_oom_retries": "10",
    }


@contextmanager
def cluster(address: str | None = None, *, workers: int | None = None) -> Iterator[Any]:
    """Connect to a cluster, yield the module `ray`, and disconnect at the end."""
    # An existing connection is used and kept. A local cluster that was started is stopped.
    connected = connect(address, workers=workers, store_bytes=SMALL_STORE_BYTES)
    ray = sys.modules["ray"]
    if connected:
        # Ray prints the death of each worker to stdout, where commands print their results.
        ray._private.worker._worker_logs_enabled = False
    try:
        yield ray
    finally:
        if connected:
            ray.shutdown()


def connect(
    address: str | None = None, *, workers: int | None = None, store_bytes: int | None = None
) -> bool:
    """Connect this process until it ends; return whether there was no connection yet."""
    if "ray" in sys.modules and sys.modules["ray"].is_initialized():
        _check_same(address)
        return False
    address = address or os.environ.get("RAY_ADDRESS") or LOCAL
    if address == LOCAL:
        _start_local(workers, store_bytes)
    else:
        _join(address)
    return True


@contextmanager
def restored_handlers() -> Iterator[None]:
    """Restore the signal handlers that Ray Tune replaces, so that Ctrl-C works after a run."""
    if threading.current_thread() is not threading.main_thread():
        # Ray, like this function, can set handlers only in the main thread.
        yield
        return
    before = {number: signal.getsignal(number) for number in _REPLACED}
    try:
        yield
    finally:
        for number, handler in before.items():
            # A handler that was not installed from Python (None) cannot be restored.
            if handler is not None:
                signal.signal(number, handler)


def cpus() -> int:
    """Return the number of CPUs of the cluster that this process is connected to."""
    import ray

    return max(int(ray.cluster_resources().get("CPU", 1)), 1)


def _start_local(workers: int | None, store_bytes: int | None) -> None:
    if "ray" not in sys.modules:
        given = any(name in os.environ for name in _TOKENS)
        for name, value in local_settings().items():
            if not (given and name in _TOKENS):
                os.environ.setdefault(name, value)
    ray = import_extra("ray", "ray")
    if ray._private.ray_constants.ENABLE_RAY_CLUSTER:
        warnings.warn(
            "Ray was imported before mcaprl.ray could set it up, so its local cluster listens on"
            f" all network interfaces; set {_LOOPBACK}=0 before Ray is imported, or call ray.init"
            " first",
            stacklevel=4,
        )
    _initialize(LOCAL, num_cpus=workers, include_dashboard=False, object_store_memory=store_bytes)


def _join(address: str) -> None:
    if address == "auto" and _CURRENT.is_file():
        address = _CURRENT.read_text().strip()
    host, _, port = address.rpartition(":")
    if host in ("127.0.0.1", "localhost"):
        # Without this variable, Ray replaces the host by this machine's address in the network.
        os.environ.setdefault(_LOOPBACK, "0")
    import_extra("ray", "ray")
    if address != "auto" and ("/" in host or not host or not port.isdecimal()):
        raise UsageError(f"`address={address!r}`: give HOST:PORT, auto or local")
    if address != "auto":
        # Try the address first, because Ray itself gives up only after minutes.
        try:
            socket.create_connection((host, int(port)), _CONNECT_S).close()
        except (OSError, OverflowError) as error:
            raise ClusterError(
                f"no Ray cluster answers at {address} ({error}): start one with `ray start --head`,"
                " or check the address and the network"
            ) from error
    _initialize(address)


def _initialize(address: str, **options: Any) -> None:
    import ray

    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR, **options)
    except Exception as error:  # Ray raises a plain Exception if a local cluster starts too slowly.
        text = " ".join(str(error).split())
        if text.startswith("Version mismatch"):
            text += "; install the versions of the cluster here"
        raise ClusterError(f"cannot use the Ray cluster at {address}: {text}") from error


def _check_same(address: str | None) -> None:
    import ray

    if address in (None, "auto"):
        return
    current = ray.get_runtime_context().gcs_address
    if address != current:
        raise UsageError(
            f"`address={address!r}`: this process is already connected to the cluster at {current}"
        )
