"""Inputs that the fuzz found: each is refused with one line that names what is wrong."""

from __future__ import annotations

import io
import json
import math
import random
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces

import mcaprl
from mcaprl.errors import LogError, McaprlError, PolicyError, TrainingError
from mcaprl.offline.estimate.values import gamma_of_run
from mcaprl.offline.selection.choice import read_choice
from mcaprl.offline.training.metrics import curve_panels
from mcaprl.recorder.dataset.formats.columns import EpisodeArrays, dataset_of
from mcaprl.recorder.format.infos import shape_of
from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import outside
from mcaprl.recorder.mapping.likely import box_limits
from mcaprl.runs import choose_seeds, read_config, saved_updates
from tests.support.bags import numbers, write_channels
from tests.support.damage.changed import changed_archive, changed_json
from tests.support.damage.datasets import dataset
from tests.support.recordings import record

h5py = pytest.importorskip("h5py", reason="needs the extra interop")
arrow = pytest.importorskip("pyarrow", reason="needs the extra tables")

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")

TINY: dict[str, Any] = {"updates": 2, "batch_size": 4, "hidden": (4,), "log_interval": 1}


def refused(reason: str, call: Callable[[], Any], kind: type[McaprlError] = McaprlError) -> None:
    with pytest.raises(kind, match=reason) as raised:
        call()
    assert "\n" not in str(raised.value)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a log and a run that was trained on it."""
    folder = tmp_path_factory.mktemp("trained")
    dataset().save(folder / "log.mcap")
    mcaprl.train(folder / "log.mcap", folder / "run", algo="cql", **TINY)
    return folder


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    shutil.copytree(trained, tmp_path / "copy")
    return tmp_path / "copy/run"


def edit(path: Path, **values: Any) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


@pytest.mark.parametrize("time_ns", [2**62, 2**63 - 1, 2**63, 2**64 - 1])
def test_log_times_whose_differences_overflow(tmp_path: Path, time_ns: int) -> None:
    path = write_channels(tmp_path / "bag.mcap", [numbers("/a", [(0, 1.0)])], time_ns)
    refused("/a: message 0 has an impossible log_time", lambda: mcaprl.info(path))
    path = write_channels(tmp_path / "last.mcap", [numbers("/a", [(0, 1.0)])], 2**62 - 1)
    found: Any = mcaprl.info(path)
    assert found.topics["/a"].last_ns == 2**62 - 1


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"env_id": 3}, "env_id must be a text"),
        ({"threshold": None}, "threshold nan or reward_scale 1.0 is impossible"),
        ({"reward_scale": 0}, "reward_scale 0.0 is impossible"),
        ({"reward_scale": 10**400}, "reward_scale must be a number"),
        ({"frame_stack": 1e400}, "frame_stack must be a whole number"),
        ({"algo": None}, "algo must be a text"),
        ({"env_kwargs": []}, "env_kwargs must be an object"),
        ({"outputs": {"q": 3}}, "outputs: q must be a list"),
        ({"acts_by": "x"}, "acts_by 'x' is not supported"),
    ],
)
def test_values_of_a_policy(run: Path, change: dict[str, Any], reason: str) -> None:
    edit(run / "seed-0/policy.json", **change)
    refused(reason, lambda: mcaprl.load_policy(run), PolicyError)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("observation.scale", 0.0, "observation.scale is not positive"),
        ("observation.shift", math.nan, "observation.shift is not finite"),
        ("q", math.inf, r"q\..* is not finite"),
    ],
)
def test_weights_of_a_policy(run: Path, name: str, value: float, reason: str) -> None:
    from mcaprl.storage.tensor_files import read_tensors, write_tensors

    path = run / "seed-0/policy.safetensors"
    tensors, description = read_tensors(path)
    next(tensor for key, tensor in tensors.items() if key.startswith(name)).fill_(value)
    write_tensors(path, tensors, description)
    refused(reason, lambda: mcaprl.load_policy(run), PolicyError)


def test_damaged_pickles_of_sb3(tmp_path: Path) -> None:
    for number, pickled in enumerate((b"\x80\x02\x94.", b"\x80\x02e.", b"\x80\x02h\xff.")):
        path = tmp_path / f"{number}.zip"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("data", "{}")
            archive.writestr("policy.pth", pickled + bytes(200))
        refused("its weights are not plain tensors", lambda p=path: mcaprl.load_policy(p))  # type: ignore[misc]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"seeds": 10**30}, "seeds must be a whole number"),
        ({"seeds": 10**9}, "cannot have 1000000000 seeds"),
        ({"seeds": 0}, "cannot have 0 seeds"),
        ({"seed": -1}, "cannot have 1 seeds from -1"),
        ({"algo": ["cql"]}, "algo must be a text"),
        ({"config": 3}, "config must be an object"),
        ({"sim": 5}, "sim must be a text"),
        ({"max_steps": "x"}, "max_steps must be a whole number"),
    ],
)
def test_values_of_a_config(run: Path, change: dict[str, Any], reason: str) -> None:
    edit(run / "config.json", **change)
    refused(f"cannot resume: .*config.json cannot be read: .*{reason}", lambda: read_config(run))
    refused(reason, lambda: choose_seeds(run, None, None, resume=True), TrainingError)
    log = run.parent / "log.mcap"
    refused(reason, lambda: mcaprl.train(log, run, resume=True), TrainingError)


def test_curves_with_other_columns(run: Path) -> None:
    path = run / "seed-0/metrics.csv"
    path.write_text(path.read_text().replace("update", "step", 1))
    refused("metrics.csv: it has no update", lambda: curve_panels(run), TrainingError)
    path.write_text("update,loss\n1,2\n")
    (run / "seed-1").mkdir()
    (run / "seed-1/metrics.csv").write_text("update\n1\n")
    refused("seed-1/metrics.csv: it has no loss", lambda: curve_panels(run), TrainingError)


def test_saved_updates_of_a_damaged_policy(run: Path) -> None:
    assert saved_updates(run, 1) == 2
    edit(run / "seed-0/policy.json", updates="many")
    refused("updates must be a whole number, got 'many'", lambda: saved_updates(run, 1))


def test_choices_of_other_types(tmp_path: Path) -> None:
    for text, reason in (("[]", "must be an object"), ('{"chosen": 3}', "chosen must be a text")):
        (tmp_path / "choice.json").write_text(text)
        refused(f"choice.json cannot be read: .*{reason}", lambda: read_choice(tmp_path))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ([], "must be an object"),
        ({"scores": []}, "has no error"),
        ({"scores": 3, "error": ""}, "scores must be a list"),
        ({"scores": [{"updates": 1}], "error": ""}, "scores has no values"),
    ],
)
def test_scores_of_a_sweep(tmp_path: Path, content: Any, reason: str) -> None:
    pytest.importorskip("ray")
    from mcaprl.ray.sweep import _open, _result, read_plan

    (trial,) = read_plan({"algos": ["bc"]}).trials
    (tmp_path / "bc-000.scores.json").write_text(json.dumps(content))
    refused(f"scores.json cannot be read: .*{reason}", lambda: _result(trial, tmp_path))
    (tmp_path / "sweep.json").write_text("3")
    refused("sweep.json cannot be read: it must be", lambda: _open(tmp_path, {}, resume=True))


def test_scores_without_values(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    from mcaprl.ray.sweep import _result, read_plan

    (trial,) = read_plan({"algos": ["bc"]}).trials
    score = {"updates": 1, "values": [], "estimator": "FQE", "trusted": True}
    (tmp_path / "bc-000.scores.json").write_text(json.dumps({"scores": [score], "error": ""}))
    refused("a score has no values", lambda: _result(trial, tmp_path), TrainingError)


def episode(**changes: Any) -> EpisodeArrays:
    rows = {"observations": np.zeros((3, 2), np.float32), "actions": np.zeros(2, np.int64)}
    given: dict[str, Any] = {**rows, "rewards": np.zeros(2), **changes}
    return EpisodeArrays(terminated=True, truncated=False, **given)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"rewards": np.zeros((2, 1))}, r"rewards has shape \(2, 1\), expected \(2,\)"),
        ({"times_ns": np.zeros((3, 1), np.int64)}, "log_time_ns has shape"),
        ({"times_ns": np.zeros(2, np.int64)}, "log_time_ns has shape"),
        ({"times_ns": np.zeros(3)}, "log_time_ns are not times"),
        ({"times_ns": np.full(3, 2**63, np.uint64)}, "log_time_ns are not times"),
        ({"times_ns": np.full(3, -1)}, "log_time_ns are not times"),
        ({"behavior_probs": np.float64(1)}, "behavior_probs has shape"),
        ({"summary": {"reason": 3}}, "reason must be a text"),
        ({"summary": {"epsilon": "x"}}, "epsilon must be a number"),
        ({"summary": {"seed": -1}}, "cannot store the seed -1"),
        ({"summary": {"seed": 2**80}}, "seed must be a whole number"),
    ],
)
def test_arrays_of_an_episode(changes: dict[str, Any], reason: str) -> None:
    metadata = LogMetadata.from_strings(dataset().metadata)
    assert len(dataset_of([episode()], metadata, "source")) == 2
    refused(f"source: .*{reason}", lambda: dataset_of([episode(**changes)], metadata, "source"))


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("start_time_ns", math.inf, "start_time_ns must be a whole number"),
        ("terminated", "text", "terminated must be true or false"),
        ("total_reward", "1", "total_reward must be a number"),
        ("reason", None, "reason must be a text"),
        ("start_time_ns", -1, "its times are impossible"),
        ("end_time_ns", 2**62, "its times are impossible"),
    ],
)
def test_episodes_of_parquet(tmp_path: Path, name: str, value: Any, reason: str) -> None:
    import pyarrow.parquet as parquet

    dataset().save(tmp_path / "log.mcap")
    mcaprl.convert(tmp_path / "log.mcap", tmp_path / "tables", to="parquet")
    path = tmp_path / "tables/episodes.parquet"
    table = parquet.read_table(path)
    place = table.column_names.index(name)
    column = arrow.array([value] * len(table))
    parquet.write_table(table.set_column(place, name, column), path)
    refused(reason, lambda: mcaprl.open(tmp_path / "tables", format="parquet"), LogError)


def test_metadata_that_is_not_text(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow", reason="needs the extra tables")
    from pyarrow import parquet

    dataset().to_parquet(tmp_path / "own")
    path, key = tmp_path / "own/transitions.parquet", b"mcaprl.dataset"
    table = parquet.read_table(path)
    own = json.loads(table.schema.metadata[key])
    changed = {key: json.dumps({**own, "policy": 3}).encode()}
    parquet.write_table(table.replace_schema_metadata(changed), path)
    refused("policy is not a text", lambda: mcaprl.open(tmp_path / "own"), LogError)


def test_demonstrations_with_fewer_observations(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "demos.hdf5", "w") as file:
        group = file.create_group("data/demo_0")
        group["obs/x"], group["actions"] = np.zeros((3, 2)), np.zeros((4, 2))
        group["rewards"], group["dones"] = np.zeros(4), np.array([0, 0, 0, 1])
    reason = r"obs/x has shape \(3, 2\), but there are 4 rewards"
    refused(reason, lambda: mcaprl.open(tmp_path / "demos.hdf5"), LogError)


def test_single_values_in_minari(tmp_path: Path) -> None:
    dataset().save(tmp_path / "log.mcap")
    mcaprl.convert(tmp_path / "log.mcap", tmp_path / "own-v0", to="minari")
    with h5py.File(tmp_path / "own-v0/data/main_data.hdf5", "r+") as file:
        del file["episode_1/rewards"]
        file["episode_1/rewards"] = 1.0
    reason = "episode 1: rewards is one value, expected one for each step"
    refused(reason, lambda: mcaprl.open(tmp_path / "own-v0"), LogError)


def test_no_rows_are_outside_of_a_space() -> None:
    space = spaces.Box(0, 1, (2, 3))
    assert outside(space, np.zeros((0, 2, 3))).tolist() == []
    assert outside(space, np.array([np.zeros((2, 3)), np.full((2, 3), 2)])).tolist() == [
        False,
        True,
    ]
    assert outside(spaces.Discrete(2), np.array([0, 2])).tolist() == [False, True]


def test_limits_of_commands_of_any_size() -> None:
    assert box_limits(np.array([0.0, 1e-320])) == (-1.0, 2.0)
    assert box_limits(np.array([-1.0, 1.0])) == (-1.0, 1.0)


@pytest.mark.parametrize(
    ("text", "reason"), [("", "Expecting value"), ("3", "must be a list"), ("[-1]", r"\(-1,\)")]
)
def test_shapes_of_infos(text: str, reason: str) -> None:
    refused(f"/a: the shape of the info is damaged: .*{reason}", lambda: shape_of(text, "/a"))
    assert shape_of("[2, 3]", "/a") == (2, 3)


def test_a_log_at_the_end_of_time_is_not_continued(tmp_path: Path) -> None:
    path, space = tmp_path / "log.mcap", spaces.Box(0, 1, (2,))
    record(path, space, spaces.Discrete(2), [2], start_time_ns=2**62)
    reason = "log.mcap cannot be appended to: its last log_time is 46116860"
    refused(reason, lambda: record(path, space, spaces.Discrete(2), [2], append=True), LogError)


def test_the_discount_of_a_damaged_run(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text('{"config": {"gamma": 0.5')
    refused("config.json cannot be read: ", lambda: gamma_of_run(tmp_path), PolicyError)
    (tmp_path / "config.json").write_text('{"config": {"gamma": 1}}')
    assert gamma_of_run(tmp_path) == 1.0


def test_changes_keep_the_form_of_a_file(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=np.zeros(3))
    archive, text = (tmp_path / "a.npz").read_bytes(), b'{"a": {"b": [1, 2]}, "c": 0}'
    new = [changed_json(text, random.Random(seed)) for seed in range(200)]
    # Keys are repeated, left out and added, and values are replaced.
    assert any(each.count(b'"c"') == 2 for each in new)
    assert any(b'"b"' not in each and b'"c"' in each for each in new)
    assert sum(b"9" * 400 in each for each in new) > 2
    assert len(set(new)) > 100
    for seed in range(50):
        out = changed_archive(archive, random.Random(seed))
        assert zipfile.ZipFile(io.BytesIO(out)).testzip() is None
