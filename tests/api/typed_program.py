"""Use of the public API in another program, which mypy and pyright check in their strict modes."""

from pathlib import Path

import numpy as np

import mcaprl


def mean_reward(path: Path) -> float:
    """Return the mean reward of the logged transitions."""
    data: mcaprl.Dataset = mcaprl.open(path)
    first: mcaprl.Episode = data.episodes[0]
    assert len(first) <= len(data)
    return float(np.mean(data.rewards))


def problems(path: Path) -> list[str]:
    """Return the problems of a log as text."""
    try:
        return [str(problem) for problem in mcaprl.check(path).problems]
    except mcaprl.McaprlError as error:
        return [str(error)]


def good_episodes(path: Path, out: Path, least: float) -> int:
    """Copy the episodes with a return above `least`, and return their number."""
    return mcaprl.filter(f"total_reward > {least}", path, out, overwrite=True).episodes


if __name__ == "__main__":
    log = Path("lane-1.mcap")
    print(f"{mean_reward(log):.3f} {problems(log)} {good_episodes(log, Path('good.mcap'), 5.0)}")
