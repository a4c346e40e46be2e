"""Tests of `mcaprl.torch`: items calculated by hand, batches, workers and streams."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import torch.multiprocessing
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

import mcaprl
from mcaprl.errors import UsageError
from mcaprl.torch import TransitionDataset, TransitionStream
from tests.support.paths import GOLDEN


def numbered(lengths: list[int], terminated: list[bool] | None = None) -> mcaprl.Dataset:
    """Return episodes of these lengths; observations, actions and rewards count up from 0."""
    ends = terminated or [True] * len(lengths)
    frames = np.arange(sum(lengths) + len(lengths), dtype=np.float32)[:, np.newaxis]
    firsts = np.cumsum([0, *(length + 1 for length in lengths[:-1])])
    rows = np.concatenate([first + np.arange(n) for first, n in zip(firsts, lengths, strict=True)])
    lasts = np.cumsum(lengths) - 1
    is_terminated, is_truncated = np.zeros(len(rows), bool), np.zeros(len(rows), bool)
    is_terminated[lasts], is_truncated[lasts] = ends, np.logical_not(ends)
    return mcaprl.Dataset.from_arrays(
        observations=frames[rows],
        next_observations=frames[rows + 1],
        actions=np.arange(len(rows)),
        rewards=np.arange(len(rows), dtype=float),
        terminated=is_terminated,
        truncated=is_truncated,
        action_space=spaces.Discrete(1_000_000),
    )


def test_an_item_is_a_transition() -> None:
    item = TransitionDataset(numbered([2, 3], [True, False]))[1]
    assert {name: value.tolist() for name, value in item.items() if name != "behavior_prob"} == {
        "observation": [1.0],
        "action": 1,
        "reward": 1.0,
        "next_observation": [2.0],
        "terminated": True,
        "truncated": False,
        "discount": 0.0,
    }
    assert item["behavior_prob"].isnan()
    assert {name: value.dtype for name, value in item.items()} == {
        "observation": torch.float32,
        "action": torch.int64,
        "reward": torch.float32,
        "next_observation": torch.float32,
        "terminated": torch.bool,
        "truncated": torch.bool,
        "discount": torch.float32,
        "behavior_prob": torch.float32,
    }


def test_items_of_commands_have_log_densities() -> None:
    data = mcaprl.open(GOLDEN / "densities.mcap")
    item = TransitionDataset(data)[2]
    assert item["behavior_log_prob"].item() == 3.5
    assert "behavior_prob" not in item
    batch = TransitionDataset(data, length=4)[:]
    assert batch["behavior_log_prob"][3].tolist() == [-100, 0, 3.5, 0]


def test_returns_of_several_steps_stop_at_ends() -> None:
    # The first episode has the rewards 0, 1 and 2, and terminates. The second episode has the
    # rewards 3 and 4, and is truncated.
    batch = TransitionDataset(numbered([3, 2], [True, False]), n_steps=2, gamma=0.5)[:]
    assert batch["reward"].tolist() == [0.5, 2.0, 2.0, 5.0, 4.0]
    assert batch["next_observation"][:, 0].tolist() == [2.0, 3.0, 3.0, 6.0, 6.0]
    assert batch["discount"].tolist() == [0.25, 0.0, 0.0, 0.25, 0.5]
    assert batch["terminated"].tolist() == [False, True, True, False, False]
    assert batch["truncated"].tolist() == [False, False, False, True, True]


def test_stacks_begin_with_the_first_observation() -> None:
    batch = TransitionDataset(numbered([2, 2]), frame_stack=3)[:]
    assert batch["observation"][..., 0].tolist() == [[0, 0, 0], [0, 0, 1], [3, 3, 3], [3, 3, 4]]
    assert batch["next_observation"][..., 0].tolist() == [
        [0, 0, 1],
        [0, 1, 2],
        [3, 3, 4],
        [3, 4, 5],
    ]


def test_sequences_are_padded_after_the_end() -> None:
    data = TransitionDataset(numbered([3, 1], [False, True]), length=2, stride=2, gamma=0.5)
    batch = data[:]
    assert batch["mask"].tolist() == [[True, True], [True, False], [True, False]]
    assert batch["observation"][..., 0].tolist() == [[0, 1], [2, 0], [4, 0]]
    assert batch["next_observation"][..., 0].tolist() == [[1, 2], [3, 0], [5, 0]]
    assert batch["action"].tolist() == [[0, 1], [2, 0], [3, 0]]
    assert batch["step"].tolist() == [[0, 1], [2, 0], [0, 0]]
    # The first episode has the rewards 0, 1 and 2, so its returns are 0 + 0.5 (1 + 0.5 * 2) = 1,
    # 1 + 0.5 * 2 = 2, and 2. The second episode has one reward, 3.
    assert batch["return_to_go"].tolist() == [[1, 2], [2, 0], [3, 0]]
    assert batch["truncated"].tolist() == [[False, False], [True, False], [False, False]]
    assert "discount" not in batch


def test_batches_and_items_agree(log_path: Path) -> None:
    mcaprl.record("lane", log_path, episodes=2, epsilon=0.3)
    data = TransitionDataset(log_path, n_steps=3, gamma=0.9, frame_stack=2)
    rows = [5, 0, len(data) - 1, -2]
    batch = data[rows]
    for k, row in enumerate(rows):
        item = data[row]
        for name, value in item.items():
            assert torch.equal(value, batch[name][k]) or value.isnan()
    plain = torch.utils.data.DataLoader(data, batch_size=64)
    fast = data.loader(64, shuffle=False)
    for one, other in zip(plain, fast, strict=True):
        assert torch.equal(one["observation"], other["observation"])
        assert torch.equal(one["reward"], other["reward"])
    with pytest.raises(IndexError, match="item"):
        data[len(data)]


def test_observations_of_dict_spaces_are_dicts(log_path: Path) -> None:
    mcaprl.record("lane", log_path, observation="dashboard", episodes=1, steps=None)
    batch = TransitionDataset(log_path)[[0, 3]]
    assert batch["observation"]["depth"].shape == (2, 84, 84, 1)
    assert batch["observation"]["depth"].dtype == torch.uint8
    assert batch["next_observation"]["motion"].shape == (2, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_steps": 0}, "n_steps is 0"),
        ({"gamma": 1.5}, "gamma is 1.5"),
        ({"stride": 2}, "pass length"),
        ({"length": 4, "n_steps": 2}, "exclude each other"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        TransitionDataset(numbered([2]), **options)


def test_pickles_are_equal_and_shared() -> None:
    data = TransitionDataset(numbered([4, 3]), n_steps=2, gamma=0.9)
    copy = pickle.loads(pickle.dumps(data))
    assert torch.equal(copy[:]["reward"], data[:]["reward"])


def test_images_on_disk_are_sent_as_the_paths_of_whole_logs(tmp_path: Path) -> None:
    log = tmp_path / "image.mcap"
    mcaprl.open(GOLDEN / "image.mcap").save(log, compression="none")
    data = mcaprl.open(log, images="mapped")
    assert data.storage != "memory"
    pickled = pickle.dumps(TransitionDataset(data))
    assert torch.equal(
        pickle.loads(pickled)[0]["observation"], TransitionDataset(log)[0]["observation"]
    )
    with pytest.raises(UsageError, match="images on disk cannot be sent to another process"):
        pickle.dumps(TransitionDataset(data.filter(lambda episode: True)))


@pytest.mark.parametrize(("method", "count"), [("fork", 2), ("spawn", 1), ("forkserver", 1)])
def test_workers_read_all_items(method: str, count: int, log_path: Path) -> None:
    numbered([40, 30, 50]).save(log_path)
    data = TransitionDataset(log_path)
    loader = data.loader(16, num_workers=count, multiprocessing_context=method)
    seen = torch.cat([batch["action"] for batch in loader])
    assert sorted(seen.tolist()) == list(range(120))
    stream = TransitionStream(log_path, batch_size=16, buffer=40)
    workers = torch.utils.data.DataLoader(
        stream, batch_size=None, num_workers=count, multiprocessing_context=method
    )
    seen = torch.cat([batch["action"] for batch in workers])
    assert sorted(seen.tolist()) == list(range(120))


def shard(stream: TransitionStream, worker: int, workers: int) -> list[list[int]]:
    """Return the actions of the batches of one worker."""
    return [batch["action"].tolist() for batch in stream._batches(worker, workers)]


@given(
    lengths=st.lists(st.integers(1, 12), min_size=1, max_size=8),
    batch_size=st.integers(1, 9),
    buffer=st.integers(1, 40),
    world_size=st.integers(1, 3),
    workers=st.integers(1, 3),
    skipped=st.integers(0, 30),
)
def test_an_epoch_has_each_item_once_and_continues(
    lengths: list[int], batch_size: int, buffer: int, world_size: int, workers: int, skipped: int
) -> None:
    data = numbered(lengths)
    options: dict[str, Any] = {"batch_size": batch_size, "buffer": buffer, "seed": 3}
    streams = [
        TransitionStream(data, rank=rank, world_size=world_size, **options)
        for rank in range(world_size)
    ]
    every = [[shard(stream, k, workers) for k in range(workers)] for stream in streams]
    seen = [action for rank in every for one in rank for batch in one for action in batch]
    assert sorted(seen) == list(range(sum(lengths)))
    # All workers of all ranks have the same number of batches if there are enough items.
    counts = {len(one) for rank in every for one in rank}
    if sum(lengths) >= world_size * workers and batch_size > 1:
        assert len(counts) == 1
    assert all(len(batch) <= batch_size for rank in every for one in rank for batch in one)
    # A loader takes one batch from each worker in turn. A resumed epoch has the same remaining
    # batches.
    turns = [one[k] for k in range(max(counts)) for one in every[0] if k < len(one)]
    if len(counts) == 1:
        skipped = min(skipped, len(turns))
        again = TransitionStream(data, rank=0, world_size=world_size, **options)
        again.load_state_dict(streams[0].state_dict(batches=skipped))
        parts = [shard(again, k, workers) for k in range(workers)]
        most = max(len(part) for part in parts)
        rest = [part[k] for k in range(most) for part in parts if k < len(part)]
        assert rest == turns[skipped:]


def test_epochs_differ_and_repeat() -> None:
    stream = TransitionStream(numbered([20, 20, 20]), batch_size=10, buffer=15)
    first, second = ([b["action"].tolist() for b in stream] for _ in range(2))
    assert first != second
    assert stream.epoch == 2
    stream.set_epoch(1)
    assert [batch["action"].tolist() for batch in stream] == second
    other = TransitionStream(numbered([20, 20, 20]), batch_size=10, buffer=15, seed=1)
    assert [batch["action"].tolist() for batch in other] != first
    plain = TransitionStream(numbered([20, 20, 20]), batch_size=10, buffer=15, shuffle=False)
    assert torch.cat([batch["action"] for batch in plain]).tolist() == list(range(60))


def test_an_interrupted_epoch_continues(log_path: Path) -> None:
    numbered([20, 35, 15]).save(log_path)
    stream = TransitionStream(log_path, batch_size=8, buffer=20)
    batches = iter(stream)
    for _ in range(3):
        next(batches)
    state = stream.state_dict()
    assert state == {"seed": 0, "epoch": 0, "batches": 3}
    rest = [batch["action"].tolist() for batch in batches]
    again = TransitionStream(log_path, batch_size=8, buffer=20)
    again.load_state_dict(state)
    assert [batch["action"].tolist() for batch in again] == rest
    assert again.epoch == 1
    with pytest.raises(UsageError, match="seed 0"):
        TransitionStream(log_path, seed=1).load_state_dict(state)


def test_a_stream_reads_no_more_than_a_block(
    log_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    numbered([10] * 50).save(log_path)
    sizes: list[int] = []
    from mcaprl.offline.batches import stream as module

    read = module._Source.read

    def counted(source: Any, parts: Any) -> mcaprl.Dataset:
        found = read(source, parts)
        sizes.append(len(found))
        return found

    monkeypatch.setattr(module._Source, "read", counted)
    stream = TransitionStream(log_path, batch_size=32, buffer=80)
    assert sum(len(batch["action"]) for batch in stream) == 500
    assert max(sizes) <= 80
    # A run that resumes at the end of an epoch does not read the batches that it skips.
    sizes.clear()
    stream.load_state_dict({"seed": 0, "epoch": 0, "batches": 15})
    assert len(list(stream)) == 1
    assert sum(sizes) <= 80


def _ranks(rank: int, log: str, folder: str) -> None:
    torch.distributed.init_process_group(
        "gloo", init_method=f"file://{folder}/rendezvous", rank=rank, world_size=2
    )
    stream = TransitionStream(log, batch_size=8, buffer=30)
    loader = torch.utils.data.DataLoader(stream, batch_size=None, num_workers=2)
    actions = [batch["action"] for batch in loader]
    total = torch.tensor([len(actions)])
    torch.distributed.all_reduce(total)
    assert int(total) == 2 * len(actions), "both ranks have equally many batches"
    torch.save(torch.cat(actions), f"{folder}/{rank}.pt")
    torch.distributed.destroy_process_group()


def test_ranks_share_an_epoch(
    log_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GLOO_SOCKET_IFNAME", "lo")
    numbered([40, 30, 31]).save(log_path)
    torch.multiprocessing.start_processes(  # type: ignore[attr-defined, no-untyped-call]
        _ranks, (str(log_path), str(tmp_path)), nprocs=2, start_method="fork"
    )
    seen = torch.cat([torch.load(tmp_path / f"{rank}.pt") for rank in range(2)])
    assert sorted(seen.tolist()) == list(range(101))
