"""Run folders of offline and online training.

RUN/config.json              algorithm, settings, and where the experience comes from
RUN/seed-K/policy.json       policy of an offline run, with policy.safetensors
RUN/seed-K/best_model.zip    policy of an online run, as Stable-Baselines3 writes it
"""

from __future__ import annotations

from pathlib import Path

CONFIG_NAME = "config.json"
POLICY_NAME = "policy.json"
BEST_NAME = "best_model.zip"


def policy_files(path: Path) -> list[Path]:
    """Return the policy files of a run's seeds by rising seed; none where there are none.

    Args:
        path: Run folder, folder of one seed, or a file, which is returned as it is.
    """
    if path.is_file():
        return [path]
    numbered = {
        int(number): folder
        for folder in path.glob("seed-*")
        if (number := folder.name.removeprefix("seed-")).isdigit()
    }
    folders = [path, *(numbered[number] for number in sorted(numbered))]
    files = [folder / name for folder in folders for name in (POLICY_NAME, BEST_NAME)]
    return [file for file in files if file.exists()]
