"""Golden logs of format version 1, which later versions must read with the same contents."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest

import mcaprl
from mcaprl.recorder.columns.reader import McapReader
from mcaprl.recorder.repair.check import IMPOSSIBLE_ACTION, check_log
from tests.golden.make import CONTENTS, FILES, FOLDER, contents_of
from tests.support.damage.faults import assert_is_known
from tests.support.learner_topic import read_learner

STATED = json.loads(CONTENTS.read_text())


def test_every_golden_file_is_there() -> None:
    assert set(STATED) == set(FILES)
    assert sum(path.stat().st_size for path in FOLDER.glob("*.mcap")) < 1_000_000


@pytest.mark.parametrize("name", STATED)
def test_golden_file_has_the_reference_contents(name: str) -> None:
    path, stated = FOLDER / f"{name}.mcap", dict(STATED[name])
    assert hashlib.sha256(path.read_bytes()).hexdigest() == stated.pop("sha256"), "it is changed"
    assert json.loads(json.dumps(contents_of(path))) == stated
    # The recordings contain actions that are not in their action spaces.
    assert [one for one in check_log(path) if one.next != IMPOSSIBLE_ACTION] == []


def test_known_values() -> None:
    """Check one file against the formula that generated it, without the stored hashes."""
    (episode,) = mcaprl.open(FOLDER / "reported.mcap").episodes
    assert_is_known(episode)


def test_learner_topic_of_a_vector_environment() -> None:
    learner = read_learner(FOLDER / "vector-of-environments.mcap")
    assert set(learner.epsilon.tolist()) == {0.5}
    assert learner.policy_version.max() == 7


def test_files_have_the_compression_in_their_names() -> None:
    for name, compression in (("zstd", "zstd"), ("lz4", "lz4"), ("none", "")):
        path: Path = FOLDER / f"every-space-{name}.mcap"
        assert {chunk.compression for chunk in McapReader(path).chunks} == {compression}
