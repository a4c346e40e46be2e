"""Changed inputs of all kinds are read, or refused with one line of this package."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.damage.faults import count, tell

for module in ("h5py", "pyarrow", "rosbags", "stable_baselines3", "ray", "matplotlib"):
    pytest.importorskip(module)

CASES = {
    "mapping files": (80, 3000),
    "expressions": (120, 5000),
    "ROS 2 bags": (40, 1500),
    "ROS 1 bags": (100, 4000),
    "JSON and protobuf bags": (80, 3000),
    "sweep files": (60, 2500),
    "logs": (30, 1200),
    "npz": (120, 5000),
    "HDF5": (100, 4000),
    "Minari": (50, 2000),
    "Parquet and LeRobot": (50, 2000),
    "policies": (60, 2500),
    "SB3 policies": (60, 2500),
    "runs": (4, 150),
    "auto runs": (3, 100),
    "online runs": (4, 150),
    "sweeps": (8, 300),
}
"""Number of cases of each target in `make test` and in `make faults`."""


def test_each_target_has_a_number_of_cases() -> None:
    from tests.support.damage.targets import TARGETS

    assert CASES.keys() == TARGETS.keys()


@pytest.mark.parametrize("target", CASES)
def test_changed_inputs(tmp_path: Path, target: str) -> None:
    cases = count(*CASES[target])
    program = [sys.executable, "-m", "tests.support.damage.fuzz", target, str(tmp_path / "fuzz")]
    done = subprocess.run(
        [*program, str(cases)], capture_output=True, text=True, check=False, timeout=1200
    )
    # A process that was killed has printed the number of its last case.
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    tried, _, refused, _ = done.stdout.splitlines()[-1].split()
    assert int(tried) == cases
    assert int(refused) > 0 or cases < 10
    tell(f"changed {target}", tried=tried, refused=refused, other_exceptions=0)
