"""Online training of policies in a sim."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mcaprl.api.environments import all_options
from mcaprl.api.policies import TrainedPolicy, as_names, is_policy, load_policies
from mcaprl.api.ranges import check_least, check_port
from mcaprl.api.replay import LiveAddress
from mcaprl.api.train import torch_threads
from mcaprl.errors import UsageError
from mcaprl.progress import ProgressCallback
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.open import open_logs
from mcaprl.recorder.record.layout import LAYOUT_NAME
from mcaprl.recorder.viewer.foxglove_server import DEFAULT_PORT

if TYPE_CHECKING:
    from mcaprl.online.train import OnlineSummary


def train_online(
    sim: str | None,
    out: str | Path,
    *,
    algo: str | None = None,
    preset: str | None = None,
    seeds: int = 1,
    seed: int = 0,
    threads: int = 1,
    record: str | Path | None = None,
    sources: str | Path | Sequence[str | Path] = (),
    resume: bool = False,
    live: bool = False,
    port: int = DEFAULT_PORT,
    allow_origin: str | Sequence[str] = (),
    observation: str | None = None,
    rules: str | None = None,
    sim_options: Mapping[str, Any] | None = None,
    on_live: Callable[[LiveAddress], None] = lambda address: None,
    progress: ProgressCallback = lambda now: None,
    **settings: Any,
) -> list[OnlineSummary]:
    """Train a policy in a sim; the same seed and machine produce the same curve.

    Args:
        sim: Short name of a sim, or a Gymnasium id; None for that of the preset or of the resumed
            run.
        out: Run folder to create.
        algo: `dqn`, `double-dqn`, `ppo` or `a2c`; None for the default of the preset, run or sim.
        preset: Name of published settings.
        seeds: Number of agents, which are trained one after the other.
        seed: Seed of the first agent; agent k uses seed + k.
        threads: Number of threads of PyTorch.
        record: Output log of all transitions; with several seeds, a folder.
        sources: Logs that fill the replay buffer, and at most one policy whose weights initialize
            the agents.
        resume: Whether training continues from the checkpoints in `out`.
        live: Whether viewers can connect during training; slow viewers miss frames.
        port: Port on 127.0.0.1 for viewers; 0 for any free port.
        allow_origin: Origin, or several, of web pages that may connect, besides pages on this
            machine, Foxglove and Lichtblick.
        observation: Observation that the sim returns, such as `depth`.
        rules: Rules of the sim, such as `classic`.
        sim_options: Other arguments of the environment.
        on_live: Function called with the address once viewers can connect.
        progress: Function called repeatedly during training.
        **settings: Settings of the algorithm; their defaults are the preset's or the sim's, or
            with `resume` the run's.

    Returns:
        One summary for each seed.

    Raises:
        UnknownNameError: There is no such sim, algorithm or preset.
        UsageError: No sim is given, the arguments contradict the preset, or a number is out of
            range.
        OutputExistsError: `out` or `record` exists.
        SpaceError: The algorithm does not support the observations or actions.
        PolicyError: The policy's network in `sources` differs from the agent's.
        TrainingError: `out` cannot be written, or contains a run of another task.
        MissingExtraError: The packages of the `online` extra are not installed.
    """
    from mcaprl.online.live import LiveTraining
    from mcaprl.online.task import choose_task
    from mcaprl.online.train import train

    check_least(1, seeds=seeds, threads=threads)
    check_least(0, seed=seed)
    check_port(port)
    out = Path(out)
    options = all_options(observation, rules, sim_options)
    task = choose_task(sim, algo, options, settings, preset=preset, resumed=out if resume else None)
    data, policy = _experience([sources] if isinstance(sources, str | Path) else sources)
    with ExitStack() as stack:
        stack.enter_context(torch_threads(threads))
        viewers = None
        if live:
            viewers = stack.enter_context(
                closing(LiveTraining(task, port=port, origins=as_names(allow_origin)))
            )
            stream = viewers.stream
            on_live(LiveAddress(stream.app_url, stream.url, out / LAYOUT_NAME))
        return train(
            task,
            out,
            seeds=seeds,
            seed=seed,
            record=record,
            data=data,
            policy=policy,
            resume=resume,
            live=viewers,
            progress=progress,
        )


def _experience(
    sources: Sequence[str | Path],
) -> tuple[Dataset | None, list[TrainedPolicy] | None]:
    """Return the dataset and the policies, one per seed, among the sources."""
    policies = [source for source in sources if is_policy(Path(source))]
    if len(policies) > 1:
        names = " and ".join(map(str, policies))
        raise UsageError(f"pass at most one policy to start from, not {names}")
    logs = [source for source in sources if source not in policies]
    data = open_logs(logs) if logs else None
    return data, load_policies(policies[0]) if policies else None
