"""Tests of compilation on first use, and of the cache."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import FrameType
from typing import NamedTuple

import numba
import numpy as np
import pytest

from mcaprl.sims.geometry import heading_of
from mcaprl.sims.powerline.rules import FLIGHT_SIZE, flight_at
from tests.support.paths import ROOT


class OtherPair(NamedTuple):
    """NamedTuple of another package, whose constructor is its own."""

    first: float
    second: float


CODE = "from mcaprl.sims.geometry import wrap_angle; print(wrap_angle(4.0))"
CACHE = Path("sims", "__pycache__")
RESULT = "-2.2831853071795862\n"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """Return a copy of the sims that was never compiled."""
    package = tmp_path / "fresh" / "mcaprl"
    shutil.copytree(ROOT / "sims", package / "sims", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("errors.py", "lazy.py"):
        shutil.copy(ROOT / "mcaprl" / name, package)
    (package / "__init__.py").touch()
    return package


def run(package: Path, user_cache: Path) -> list[str]:
    """Compile in another process; return the lines on its stderr."""
    kept = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    places = {"PYTHONPATH": str(package.parent), "XDG_CACHE_HOME": str(user_cache)}
    done = subprocess.run(
        [sys.executable, "-B", "-c", CODE],
        env={**kept, **places, "HOME": str(user_cache)},
        cwd=package.parent,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == RESULT
    return done.stderr.splitlines()


def test_compilation_is_announced_once_and_cached(package: Path, tmp_path: Path) -> None:
    assert run(package, tmp_path) == ["compiling geometry for this machine, once"]
    assert run(package, tmp_path) == []
    assert list((package / CACHE).glob("geometry.wrap_angle*.nbi"))


def test_without_a_writable_package_the_users_cache_is_used(package: Path, tmp_path: Path) -> None:
    # With a file in place of the folder, even root cannot write there.
    (package / CACHE).touch()
    assert run(package, tmp_path) == ["compiling geometry for this machine, once"]
    assert run(package, tmp_path) == []


def test_without_a_writable_cache_each_process_compiles(package: Path, tmp_path: Path) -> None:
    (package / CACHE).touch()
    nowhere = tmp_path / "file"
    nowhere.touch()
    for _ in range(2):
        (line,) = run(package, nowhere)
        assert line == (
            "compiling geometry for this machine, again in each process:"
            " no cache folder is writable; set NUMBA_CACHE_DIR"
        )


def test_a_returned_namedtuple_runs_no_python_code() -> None:
    # A KeyboardInterrupt in such code would crash the process.
    row = np.arange(FLIGHT_SIZE, dtype=np.float64)
    heading_of(0.0), flight_at(row)
    called: list[str] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            called.append(frame.f_code.co_name)

    before = sys.getprofile()
    sys.setprofile(note)
    heading, flight = heading_of(0.0), flight_at(row)
    sys.setprofile(before)
    # numba reports the compiled functions themselves, but not with Python 3.14.
    assert called == (["heading_of", "flight_at"] if sys.version_info < (3, 14) else [])
    assert heading._asdict() == {"cos": 1.0, "sin": 0.0}
    assert flight.drone.attitude._asdict() == {"w": 6.0, "x": 7.0, "y": 8.0, "z": 9.0}


def test_other_packages_keep_numbas_conversion() -> None:
    def swap(pair: OtherPair) -> OtherPair:
        return OtherPair(pair.second, pair.first)

    assert numba.njit(swap)(OtherPair(1.0, 2.0)) == OtherPair(2.0, 1.0)
