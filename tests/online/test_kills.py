"""Test that training can be killed at any operation on its files, and ends with the same bits."""

from __future__ import annotations

import json
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import pytest

from tests.support.damage.faults import count
from tests.support.paths import ROOT

# With a stride of 1, training is killed at each operation once, which takes minutes. The stride of
# `make faults` is smaller than that of `make test`.
SCRIPT = """
    import hashlib, json, os, sys, warnings
    from pathlib import Path
    import mcaprl
    from mcaprl.errors import LogError
    from mcaprl.online.task import Task
    from mcaprl.online.train import train
    from mcaprl.recorder.columns.output import OutputFile
    from mcaprl.storage.tensor_files import read_tensors

    warnings.simplefilter("ignore")
    folder, case = Path(sys.argv[1]), json.loads(sys.argv[3])
    run, name = folder / "run", "log" if case["seeds"] > 1 else "log.mcap"
    log = folder / "logs" / name
    settings = dict(
        steps=90, hidden=(4,), eval_interval=40, eval_episodes=1, final_episodes=1,
        learning_starts=1, checkpoint_interval=25, buffer_size=100, batch_size=2,
    )
    task = Task.for_sim("lane", case["algo"], case["sim"], **{**settings, **case["settings"]})
    data = None
    if case["with_data"]:
        mcaprl.record("lane", episodes=2, out=folder / "from.mcap", sim_options=case["sim"])
        data = mcaprl.open(folder / "from.mcap")
    options = dict(seeds=case["seeds"], data=data, progress=lambda now: None)
    EVENTS = ("os.rename", "os.link", "os.mkdir", "os.remove", "os.rmdir", "open")
    left = 0

    def count():
        global left
        left -= 1
        if left == 0:
            os._exit(9)

    def on_event(name, arguments):
        if name in EVENTS and str(folder) in str(arguments[0]):
            if name != "open" or arguments[2] & (os.O_WRONLY | os.O_RDWR):
                count()

    write = OutputFile._write

    def counted_write(self, *parts):
        count()
        write(self, *parts)
        count()

    def session(number):
        # Dies at its operation `number`, if there are as many.
        global left
        OutputFile._write = counted_write
        sys.addaudithook(on_event)
        left = number
        train(task, run, record=log, resume=run.exists(), **options)
        train(task, run, record=log, resume=True, **options)

    def logs_of(log):
        return sorted(log.glob("*.mcap")) if log.is_dir() else [log]

    def kept(path):
        try:
            return len(mcaprl.open(path).episodes)
        except (LogError, OSError):
            return 0

    def needed(seed):
        # The episodes before the checkpoint; those after it are recorded again.
        path = run / f"seed-{seed}" / "checkpoint.safetensors"
        return read_tensors(path)[1]["episodes_in_log"] if path.exists() else 0

    def digests(run, log):
        names = ("checkpoint.safetensors", "policy.safetensors", "policy.json", "curve.csv")
        files = [(each / name).read_bytes() for each in run.glob("seed-*") for name in names]
        for path in logs_of(log):
            data = mcaprl.open(path)
            files += [column.tobytes() for column in (data.observations, data.actions)]
            files += [column.tobytes() for column in (data.rewards, data.behavior_log_probs)]
        return sorted(hashlib.sha256(content).hexdigest() for content in files)

    whole = folder / "whole"
    whole.mkdir()
    train(task, whole / "run", record=whole / name, **options)
    expected = digests(whole / "run", whole / name)
    number, status, stride = 0, 9, int(sys.argv[2])
    while status == 9:
        number += stride
        child = os.fork()
        if child == 0:
            try:
                session(number)
            except BaseException as error:
                print(number, type(error).__name__, error, flush=True)
                os._exit(1)
            os._exit(0)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        for seed in range(case["seeds"]):
            path = log / f"seed-{seed}.mcap" if case["seeds"] > 1 else log
            assert kept(path) >= needed(seed), (number, seed, kept(path), needed(seed))
    assert digests(run, log) == expected
    print(number, sum(map(kept, logs_of(log))), status)
    sys.exit(status)
"""


BOX = {"actions": "continuous"}
CASES: dict[str, dict[str, Any]] = {
    "double-dqn": {},
    "sac": {"sim": BOX, "settings": {"envs": 4, "steps_per_update": 2}, "with_data": True},
    "td3": {"sim": BOX, "settings": {"envs": 2, "n_steps": 2}, "seeds": 2},
}
OTHERWISE: dict[str, Any] = {"sim": {}, "settings": {}, "seeds": 1, "with_data": False}


@pytest.mark.parametrize("algo", CASES)
def test_a_run_killed_at_operations_on_its_files_resumes(tmp_path: Path, algo: str) -> None:
    case = json.dumps({**OTHERWISE, **CASES[algo], "algo": algo})
    stride = count(small=37, large=5)
    command = [sys.executable, "-c", textwrap.dedent(SCRIPT), str(tmp_path), str(stride), case]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    number, episodes, _ = map(int, done.stdout.split())
    assert number > 100
    assert episodes > 3
