"""Tests that training can be killed at any operation on its files, and then resumed."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

from tests.support.damage.faults import count
from tests.support.paths import ROOT

# With a stride of 1, training is killed at each operation once, which takes minutes. The stride of
# `make faults` is smaller than that of `make test`.
SCRIPT = """
    import os, sys, warnings
    from pathlib import Path
    import mcaprl
    from stable_baselines3 import DQN
    from mcaprl.errors import LogError
    from mcaprl.online.task import Task
    from mcaprl.online.train import train
    from mcaprl.recorder.columns.output import OutputFile

    warnings.simplefilter("ignore")
    folder = Path(sys.argv[1])
    run, log = folder / "run", folder / "log" / "lane.mcap"
    task = Task.for_sim(
        "lane", "dqn", steps=90, hidden=(4,), eval_interval=40, eval_episodes=1,
        final_episodes=1, learning_starts=1, checkpoint_interval=25, buffer_size=100,
        batch_size=2,
    )
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
        train(task, run, record=log, resume=run.exists(), progress=lambda now: None)
        model = DQN.load(run / "seed-0" / "best_model.zip")
        (summary,) = train(task, run, record=log, resume=True, progress=lambda now: None)
        assert model.num_timesteps == summary.best_step

    def kept():
        try:
            return len(mcaprl.open(log).episodes)
        except (LogError, OSError):
            return 0

    episodes, number, status, stride = 0, 0, 9, int(sys.argv[2])
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
        assert kept() >= episodes, (number, kept(), episodes)
        episodes = kept()
    print(number, episodes, status)
    sys.exit(status)
"""


def test_a_run_killed_at_operations_on_its_files_resumes(tmp_path: Path) -> None:
    stride = count(small=37, large=5)
    command = [sys.executable, "-c", textwrap.dedent(SCRIPT), str(tmp_path), str(stride)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    number, episodes, _ = map(int, done.stdout.split())
    assert number > 100
    # The number of episodes depends on the operations at which training was killed.
    assert episodes > 3
