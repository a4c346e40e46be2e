"""Manifests of recordings: the files that are read, and the errors for wrong manifests."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import mcaprl
from mcaprl.errors import LogError
from mcaprl.recorder.dataset.open import LogFile, write_manifest
from tests.support.damage.faults import write_log


@pytest.fixture
def manifest(tmp_path: Path) -> Path:
    """Return the manifest of two logs, which it does not list in the order of their names."""
    files = []
    for name, episodes in (("b.mcap", 1), ("a.mcap", 2)):
        write_log(tmp_path / name, episodes)
        data = mcaprl.open(tmp_path / name)
        size = (tmp_path / name).stat().st_size
        files.append(LogFile(name, episodes, len(data), size))
    write_log(tmp_path / "other.mcap", 3)
    return write_manifest(tmp_path, files)


def test_the_listed_logs_are_read_in_their_order(manifest: Path) -> None:
    data = mcaprl.open(manifest)
    assert [path.name for path in data.sources] == ["b.mcap", "a.mcap"]
    assert [episode.summary.episode for episode in data.episodes] == [0, 0, 1]
    assert len(mcaprl.open([manifest, manifest.parent / "other.mcap"]).episodes) == 6
    assert mcaprl.info(str(manifest)).episodes == 3


def test_a_url_of_a_manifest_is_read(manifest: Path) -> None:
    pytest.importorskip("fsspec")
    assert mcaprl.open(f"file://{manifest}").fingerprint == mcaprl.open(manifest).fingerprint


def test_missing_and_changed_files_are_one_error(manifest: Path) -> None:
    path = manifest.with_name("a.mcap")
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(LogError, match=r"a\.mcap has \d+ bytes, but .* lists \d+: it was changed"):
        mcaprl.open(manifest)
    with pytest.raises(LogError, match=r"has \d+ bytes"):
        mcaprl.open(f"file://{manifest}")
    path.unlink()
    with pytest.raises(LogError, match=r"lists a\.mcap, which is missing"):
        mcaprl.open(manifest)
    manifest.unlink()
    with pytest.raises(LogError, match=r"cannot read .*: No such file"):
        mcaprl.open(manifest)


@pytest.mark.parametrize(
    "content",
    [
        "[]",
        "{",
        '{"files": 3}',
        '{"files": [{"name": "a.mcap"}]}',
        *(
            json.dumps({"files": [{"name": name, "episodes": 1, "steps": 1, "size_bytes": 1}]})
            for name in ("../a.mcap", "/etc/a.mcap", "x/a.mcap", "a.txt", "..\\a.mcap")
        ),
    ],
)
def test_a_manifest_that_names_no_logs_of_its_folder_is_refused(
    manifest: Path, content: str
) -> None:
    manifest.write_text(content)
    with pytest.raises(LogError, match="is not a manifest of logs"):
        mcaprl.open(manifest)
    manifest.write_text('{"files": []}')
    with pytest.raises(LogError, match="lists no files"):
        mcaprl.open(manifest)
