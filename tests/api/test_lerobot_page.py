"""The page about LeRobot: its ACT is trained on a bag, and its predictions are evaluated."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import mcaprl
from mcaprl.cli import run
from tests.docs.pages import ROOT, Run, commands
from tests.support.lerobot.environment import run_lerobot

PAGE = ROOT / "docs/howto/lerobot.md"
# In a test, ACT is small and learns fast.
SMALL = (
    "--policy.pretrained_backbone_weights=null --policy.use_vae=false --policy.dim_model=32"
    " --policy.dim_feedforward=64 --policy.n_encoder_layers=1 --policy.n_heads=4"
    " --policy.optimizer_lr=3e-3 --policy.dropout=0 --batch_size=8 --num_workers=0"
    " --wandb.enable=false"
)


def _commands(program: str) -> list[list[str]]:
    blocks = re.findall(r"```sh\n(.*?)```", PAGE.read_text(), re.DOTALL)
    lines = [shlex.split(line) for block in blocks for line in commands(block)]
    return [words[1:] for words in lines if words[0] == program]


def _train(words: list[str], steps: int, folder: Path) -> None:
    kept = [word for word in words if not word.startswith("--steps")]
    run_lerobot("run", *kept, *SMALL.split(), f"--steps={steps}", folder=folder)


@pytest.mark.long
def test_act_is_trained_on_a_bag_and_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The page is run in LeRobot's environment, with a small ACT."""
    monkeypatch.chdir(tmp_path)
    Run(quick=True).page(PAGE)
    (train,) = _commands("lerobot-train")
    predict, train_on_log = _commands("python")
    _train(["lerobot.scripts.lerobot_train", *train], 20, tmp_path)
    run_lerobot("run", *predict, folder=tmp_path)
    capsys.readouterr()
    (evaluate,) = (words for words in _commands("mcaprl") if words[0] == "evaluate")
    assert run([*evaluate, "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["action_errors"]["policies"]
    assert (found["episodes"], found["horizon"]) == (2, 10)
    assert found["why"] == "those in the folder, of 8"

    data = mcaprl.open("bag", mapping="robot.yaml")
    gaps = []
    for episode in data.episodes[6:]:
        chunks = np.load(f"predictions/episode-{episode.index}.npy")
        assert chunks.shape == (len(episode), 10, 2)
        gaps.append(np.abs(chunks[:, 0] - episode.actions))
    mean = np.concatenate(gaps).mean(0)
    for column, part in enumerate(found["parts"]):
        assert part["mean"] == pytest.approx(mean[column], rel=1e-5)
        # The mean command is 0.6 away from a sine, and ACT sees the command in the image.
        assert part["mean"] < 0.5 * part["baselines"]["mean"]
    assert "the worst ten seconds" in Path("errors/index.html").read_text()
    (annotate,) = (words for words in _commands("mcaprl") if words[0] == "annotate")
    assert run(annotate) == 0
    assert {"/camera", "/cmd_vel", "/rl/step"} < set(mcaprl.open_bag("shown.mcap").topics)
    steps = sum(len(episode) for episode in data.episodes[6:])
    assert mcaprl.open_bag("shown.mcap").topics["/rl/values"].count == steps

    _train(train_on_log, 2, tmp_path)
    checkpoint, same = (
        json.loads(Path(folder, "checkpoints/last/pretrained_model/config.json").read_text())
        for folder in ("act_on_log", "act")
    )
    assert checkpoint == same
