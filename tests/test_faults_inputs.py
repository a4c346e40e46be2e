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
    "mapping files": (60, 800),
    "expressions": (100, 1500),
    "ROS 2 bags": (30, 300),
    "definition files": (60, 800),
    "ROS 1 bags": (60, 600),
    "JSON and protobuf bags": (60, 400),
    "sweep files": (40, 400),
    "logs": (20, 120),
    "logs of sims": (10, 80),
    "npz": (100, 800),
    "HDF5": (60, 500),
    "Minari": (30, 250),
    "Parquet and LeRobot": (30, 250),
    "policies": (30, 300),
    "SB3 policies": (40, 400),
    "runs": (3, 25),
    "auto runs": (2, 15),
    "online runs": (3, 25),
    "sweeps": (6, 50),
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
