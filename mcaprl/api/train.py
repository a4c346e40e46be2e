"""Offline training of policies from logs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mcaprl.api.data import Data
from mcaprl.api.ranges import check_least
from mcaprl.errors import MissingExtraError, UsageError
from mcaprl.progress import ProgressCallback
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.runs import run_to_resume
from mcaprl.settings import check_settings, settings_from_json

if TYPE_CHECKING:
    from mcaprl.offline.training.metrics import OfflineSummary


def train(
    data: Data,
    out: str | Path,
    *,
    algo: str | None = None,
    seeds: int = 1,
    seed: int = 0,
    threads: int = 1,
    device: str = "cpu",
    resume: bool = False,
    follow: bool = False,
    other_data: bool = False,
    on_data: Callable[[str, Dataset], None] = lambda algo, dataset: None,
    progress: ProgressCallback = lambda now: None,
    **settings: Any,
) -> list[OfflineSummary]:
    """Train a policy offline; the same seed, data and machine produce the same weights.

    The run folder contains the policy, checkpoints and metrics of each seed, and `curves.png` if
    matplotlib is installed.

    Args:
        data: Dataset, file, folder or glob of logs, or several of them. `PATH:2` draws
            the transitions of PATH twice as often as others.
        out: Run folder to create.
        algo: `dqn`, `double-dqn`, `cql`, `bc`, `bcq` or `iql`; None for that of the resumed
            run, or else `cql`.
        seeds: Number of networks, which are trained in parallel.
        seed: Seed of the first network; network k uses seed + k.
        threads: Number of threads of PyTorch and of the reader.
        device: `cpu` or `cuda`.
        resume: Whether training continues from the checkpoints in `out`.
        follow: Whether episodes that another process adds to the logs are used.
        other_data: Whether `resume` accepts checkpoints trained on other data.
        on_data: Function called with the algorithm and the dataset before the first update.
        progress: Function called with each row of metrics.
        **settings: Settings of the algorithm; their defaults are the algorithm's, or with `resume`
            the run's.

    Returns:
        One summary for each seed.

    Raises:
        UnknownNameError: There is no such algorithm.
        UsageError: The algorithm has no such setting, there is no such device, or a number is out
            of range.
        OutputExistsError: `out` contains a run.
        LogError: The logs cannot be read.
        SpaceError: The algorithm does not support the observations or actions.
        TrainingError: The loss is not finite, or `out` has a run with other data or settings.
        MissingExtraError: The packages of the `offline` extra are not installed.
    """
    from mcaprl.offline.algorithms.registry import choose_algorithm
    from mcaprl.offline.batches.sources import open_weighted
    from mcaprl.offline.training.curves import draw_curves
    from mcaprl.offline.training.follow import GrowingLogs
    from mcaprl.offline.training.train import train as train_dataset

    check_least(1, seeds=seeds, threads=threads)
    check_least(0, seed=seed)
    out = Path(out)
    if resume:
        earlier = run_to_resume(out)
        algo = algo or earlier.get("algo")
        settings = {**settings_from_json(earlier.get("config")), **settings}
    algo = algo or "cql"
    _, defaults = choose_algorithm(algo)
    check_settings(algo, defaults, settings)
    config = type(defaults)(**settings)
    with torch_threads(threads):
        growing, weights = None, None
        if isinstance(data, Dataset):
            if follow:
                raise UsageError("follow needs the paths of logs, not a dataset")
            dataset = data
        elif follow:
            growing = GrowingLogs(_names(data))
            dataset = growing.dataset
        else:
            dataset, weights = open_weighted(_names(data), threads=threads)
        on_data(algo, dataset)
        summaries = train_dataset(
            dataset,
            config,
            out,
            seeds=seeds,
            seed=seed,
            weights=weights,
            resume=resume,
            # The checkpoints were trained on the logs before they grew.
            other_data=other_data or follow,
            follow=growing,
            device=device,
            progress=progress,
        )
    with suppress(MissingExtraError):
        draw_curves(out)
    return summaries


@contextmanager
def torch_threads(threads: int) -> Iterator[None]:
    """Set the number of threads of PyTorch, and restore it afterward."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _names(data: str | Path | Sequence[str | Path]) -> list[str]:
    return [str(data)] if isinstance(data, str | Path) else list(map(str, data))
