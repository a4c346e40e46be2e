"""Tests of the requirements on a cluster, and of the errors if they are not met."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import ClusterError, MissingExtraError, UsageError
from mcaprl.ray import cluster, tasks
from mcaprl.recorder.format.metadata import installed_versions
from tests.ray.processes import open_files
from tests.ray.seeded import SEEDED


def record_elsewhere(folder: Path, address: str, before: str = "") -> str:
    """Record in another process; return the lines that mcaprl wrote to stderr."""
    arguments = ["record", SEEDED, "--policy", "random", "--episodes", "2", "--ray"]
    arguments += ["--address", address, "--out", str(folder)]
    code = f"import sys\n{before}\nfrom mcaprl.cli import main\nmain({arguments!r})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    lines = [line for line in done.stderr.splitlines() if "mcaprl: " in line]
    assert "Traceback" not in done.stderr
    assert len(lines) == 1, done.stderr
    return lines[0]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@pytest.mark.parametrize(
    "command",
    [
        ["record", SEEDED, "--policy", "random", "--episodes", "2", "--ray", "--out", "a"],
        ["evaluate", "random", "--sim", SEEDED, "--episodes", "2", "--ray"],
        ["train-offline", "none.mcap", "--ray", "--out", "a"],
        ["train-offline", "none.mcap", "--ray", "--out", "a", "--sweep", "sweep.json"],
    ],
)
def test_an_unreachable_cluster_is_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    command: list[str],
) -> None:
    ray = pytest.importorskip("ray")
    # This process may be connected to the cluster of the tests.
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sweep.json").write_text('{"algos": ["bc"]}')
    address = f"127.0.0.1:{free_port()}"
    assert run([*command, "--address", address]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"mcaprl: no Ray cluster answers at {address} (")
    assert error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["sweep.json"]
    with pytest.raises(ClusterError, match="no Ray cluster answers"):
        mcaprl.ray.read(tmp_path, address=address)


def test_a_local_cluster_that_starts_too_slowly_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ray = pytest.importorskip("ray")

    def init(**options: Any) -> None:
        raise Exception("The current node timed out during startup.\nSee the logs.")  # as Ray does

    monkeypatch.setattr(ray, "init", init)
    with pytest.raises(ClusterError, match=r"cluster at local: The current .* startup\. See the"):
        cluster._initialize("local")


@pytest.mark.parametrize("address", ["somewhere", "ray://127.0.0.1:10001", ":6379", "host:x"])
def test_an_address_that_is_no_host_and_port_is_refused(address: str) -> None:
    pytest.importorskip("ray")
    with pytest.raises(UsageError, match="give HOST:PORT"):
        cluster._join(address)


@pytest.mark.usefixtures("ray_cluster")
def test_another_version_of_ray_is_one_line(tmp_path: Path) -> None:
    import ray

    address = ray.get_runtime_context().gcs_address
    other = "import ray; ray.__version__ = '1.2.3'"
    line = record_elsewhere(tmp_path / "a", address, other)
    assert f"cannot use the Ray cluster at {address}: Version mismatch: " in line
    assert "Ray: 1.2.3" in line
    assert line.endswith("install the versions of the cluster here")


@pytest.mark.usefixtures("ray_cluster")
def test_other_versions_of_packages_on_a_worker_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    versions = {**installed_versions(), "numpy": "1.2.3"}
    monkeypatch.setattr(tasks, "installed_versions", lambda: versions)
    with pytest.raises(ClusterError, match=r"the worker at 127\.0\.0\.1 has numpy .* 1\.2\.3: in"):
        mcaprl.record(SEEDED, tmp_path / "a", policy="random", episodes=2, ray=True)


@pytest.mark.usefixtures("ray_cluster")
def test_a_path_that_a_worker_does_not_see_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ClusterError, match=r"127\.0\.0\.1 cannot see .*/none: choose a path"):
        tasks.run_tasks(_nothing, [1, 2], paths=[tmp_path / "none"])


def _nothing(request: int, report: Any) -> int:
    return request


@pytest.mark.usefixtures("ray_cluster")
def test_results_are_in_the_order_of_the_requests() -> None:
    assert tasks.run_tasks(_nothing, list(range(5)), workers=3) == [0, 1, 2, 3, 4]
    assert tasks.run_tasks(_nothing, []) == []


@pytest.mark.usefixtures("ray_cluster")
def test_a_task_that_makes_progress_is_repeated_after_any_number_of_deaths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tasks, "MOST_DEATHS", 2)
    amounts: list[int] = []
    news: list[Any] = []
    run = tasks.run_tasks(_dying, [tmp_path], advance=amounts.append, on_news=news.append)
    assert run == [5]
    assert sum(amounts) == 5
    assert news == [f"attempt {number}" for number in range(6)]


def _dying(folder: Path, send: Any) -> int:
    """Kill this worker in the first five attempts, each of which makes progress."""
    attempt = len(list(folder.iterdir()))
    (folder / str(attempt)).touch()
    send(attempt, f"attempt {attempt}")
    if attempt < 5:
        os.kill(os.getpid(), signal.SIGKILL)
    return attempt


@pytest.mark.usefixtures("ray_cluster")
def test_a_second_connection_is_the_first_one() -> None:
    import ray

    with cluster.cluster("auto"), cluster.cluster(ray.get_runtime_context().gcs_address):
        pass
    assert ray.is_initialized()
    with pytest.raises(UsageError, match="already connected to the cluster at"):
        cluster.connect("127.0.0.1:1")


@pytest.mark.usefixtures("ray_cluster")
def test_the_cluster_listens_on_the_loopback_interface_alone() -> None:
    """Check the addresses of all sockets of the processes that this process started."""
    tables = [Path(f"/proc/net/{name}") for name in ("tcp", "tcp6")]
    if not tables[0].exists():
        pytest.skip("needs /proc")
    listening = {}
    for table in tables:
        for line in table.read_text().splitlines()[1:] if table.exists() else ():
            fields = line.split()
            if fields[3] == "0A":
                listening[fields[9]] = fields[1].partition(":")[0]
    loopback = {"0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000"}
    links = {link for _, link in open_files() if link.startswith("socket:[")}
    owned = [listening[link[8:-1]] for link in links if link[8:-1] in listening]
    assert len(owned) >= 3
    assert set(owned) <= loopback


def test_without_ray_the_option_names_the_install_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "ray"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [_NoRay(), *sys.meta_path])
    out = str(tmp_path / "a")
    assert run(["record", SEEDED, "--policy", "random", "--episodes", "1", "--ray", "--out", out])
    expected = "mcaprl: ray is not installed: pip install 'mcaprl[ray]'"
    assert capsys.readouterr().err.strip() == expected
    with pytest.raises(MissingExtraError):
        mcaprl.evaluate("random", SEEDED, episodes=1, ray=True)
    with pytest.raises(MissingExtraError):
        mcaprl.ray.read(tmp_path)
    pytest.importorskip("torch")
    with pytest.raises(MissingExtraError):
        mcaprl.train("none.mcap", tmp_path / "run", ray=True)
    with pytest.raises(MissingExtraError):
        mcaprl.sweep("none.mcap", tmp_path / "run", {"algos": ["bc"]})
    assert list(tmp_path.iterdir()) == []


class _NoRay:
    """Import finder that raises an error for all modules of Ray."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name.partition(".")[0] == "ray":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def test_importing_mcaprl_ray_does_not_import_ray() -> None:
    code = "import sys, mcaprl, mcaprl.ray; mcaprl.ray.read; print('ray' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
