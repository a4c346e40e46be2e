"""A format of another package, which is found by its entry point."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mcaprl
from mcaprl.cli import run
from mcaprl.errors import UnknownNameError, UsageError
from tests.support.damage.datasets import dataset

MODULE = '''
import numpy as np

import mcaprl


class Columns(mcaprl.Format):
    """One CSV file with observations of one element."""

    name = "columns"
    about = "CSV file"
    suffix = ".columns"
    keeps = frozenset()

    def matches(self, path):
        return path.suffix == self.suffix

    def read(self, path, *, one_episode=False):
        rows = np.loadtxt(path, delimiter=",", ndmin=2)
        return mcaprl.Dataset.from_arrays(
            observations=rows[:, 0], next_observations=rows[:, 1], actions=rows[:, 2].astype(int),
            rewards=rows[:, 3], terminated=rows[:, 4] == 1, truncated=rows[:, 5] == 1,
        )

    def write(self, dataset, path, *, lossy):
        batch = dataset.batch(np.arange(len(dataset)))
        columns = [
            batch.observations[:, 0], batch.next_observations[:, 0], batch.actions, batch.rewards,
            batch.terminated, batch.truncated,
        ]
        np.savetxt(path, np.stack(columns, 1), delimiter=",")
        return ["elements after the first are left out"]
'''
ENTRY_POINT = "columns = columns_package:Columns"


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, entry_point: str = ENTRY_POINT) -> None:
    """Install a package into a folder on the import path, as pip does."""
    (folder / "columns_package.py").write_text(MODULE)
    info = folder / "columns-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: columns\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[mcaprl.formats]\n{entry_point}\n")
    monkeypatch.syspath_prepend(folder)


def test_an_installed_format_is_written_recognized_and_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install(tmp_path, monkeypatch)
    log, out = tmp_path / "log.mcap", tmp_path / "out.columns"
    dataset().save(log)
    assert run(["convert", str(log), str(out)]) == 0
    said = capsys.readouterr().out
    assert "lost: elements after the first are left out" in said
    assert "columns has no place for spaces, times" in said.replace("\n", " ")
    found = mcaprl.open(out)
    assert found.frames.tolist() == dataset().frames[:, 0].tolist()
    assert found.rewards.tolist() == dataset().rewards.tolist()
    assert found.truncated.tolist() == dataset().truncated.tolist()
    assert found.sources == (out,)
    assert mcaprl.open(out, format="columns", one_episode=True).fingerprint == found.fingerprint
    with pytest.raises(UsageError, match="dones is an option of reading npz, d3rlpy, hdf5, not co"):
        mcaprl.open(out, dones="terminated")
    with pytest.raises(UnknownNameError, match="columns"):
        mcaprl.open(out, format="columnz")


@pytest.mark.parametrize(
    ("entry_point", "reason"),
    [
        ("columns = no_such_module:Columns", "ModuleNotFoundError: No module named"),
        ("columns = columns_package:np", "it is not a subclass of Format"),
        ("other = columns_package:Columns", "its name is 'columns'"),
    ],
)
def test_a_broken_entry_point_is_one_line_that_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, entry_point: str, reason: str
) -> None:
    install(tmp_path, monkeypatch, entry_point)
    with pytest.raises(UsageError, match="of package columns in group mcaprl") as error:
        mcaprl.open(tmp_path, format="something")
    assert reason in str(error.value)
    # The built-in formats are found without the package.
    dataset().to_npz(tmp_path / "own.npz")
    np.testing.assert_array_equal(mcaprl.open(tmp_path / "own.npz").frames, dataset().frames)


def test_a_format_that_only_reads_says_so(tmp_path: Path) -> None:
    class ReadOnly(mcaprl.Format):
        name = "once"

    with pytest.raises(UsageError, match="once can only be read, not written"):
        ReadOnly().write(dataset(), tmp_path / "x", lossy=False)
    with pytest.raises(UsageError, match="once has no named datasets"):
        ReadOnly().located("x")
