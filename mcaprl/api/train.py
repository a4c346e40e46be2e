"""Training of policies: offline from logs, and online in a sim."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mcaprl.api.environments import all_options
from mcaprl.api.policies import Run, as_names, is_policy, load_policies
from mcaprl.api.ranges import ClusterOptions, check_least, check_port, check_positive
from mcaprl.api.replay import LiveAddress
from mcaprl.errors import MissingExtraError, TrainingError, UsageError
from mcaprl.files import write_json
from mcaprl.progress import ProgressCallback
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.edit.piece import selected
from mcaprl.recorder.record.layout import LAYOUT_NAME
from mcaprl.recorder.source import Source, open_data, opened
from mcaprl.recorder.viewer.foxglove_server import DEFAULT_PORT
from mcaprl.recorder.viewer.live_stream import DEFAULT_SPEED
from mcaprl.runs import ROBOT_NAME, check_kind, choose_seeds, run_to_resume
from mcaprl.settings import check_settings, settings_from_json
from mcaprl.storage.remote import check_upload, upload_all

if TYPE_CHECKING:
    from mcaprl.offline.algorithms.learner import Learner
    from mcaprl.offline.algorithms.registry import Algorithm
    from mcaprl.offline.policy import Policy
    from mcaprl.offline.training.metrics import OfflineSummary
    from mcaprl.online.train import OnlineSummary

MAPPING_NAME = "mapping.json"
"""Name of the file in a run folder that contains a copy of the mapping used for training."""
_OF_OPEN = {"mapping", "trust_code", "definitions", "follow", "format", "weights"}
"""Arguments of `mcaprl.open`, which are no settings of an algorithm."""


def train(
    data: Source,
    out: str | Path,
    *,
    algo: str | type[Learner] | None = None,
    seeds: int | None = None,
    seed: int | None = None,
    threads: int = 1,
    device: str = "cpu",
    resume: bool = False,
    other_data: bool = False,
    only: str | None = None,
    mask: Sequence[str] = (),
    ray: bool | ClusterOptions = False,
    progress: ProgressCallback = lambda now: None,
    **settings: Any,
) -> Run[OfflineSummary]:
    """Train a policy offline; the same seed, data and machine produce the same weights.

    The run folder contains the policy, checkpoints and metrics of each seed, the mapping of a bag,
    and `curves.png` if matplotlib is installed.

    Args:
        data: Dataset, file, folder or glob of logs, or several of them. `PATH:2` draws
            the transitions of PATH twice as often as others. Pass `mcaprl.open(...)` for bags with
            a mapping, and with `follow` to also train on episodes that end during the training; or
            a function that returns it, which is called after the arguments are checked.
        out: Run folder to create.
        algo: `dqn`, `double-dqn`, `cql`, `bc`, `bcq` or `iql`, for the actions of a Box `bc`,
            `td3-bc`, `rebrac` or `iql`, or `auto`, which chooses among them by the log; or a
            subclass of `mcaprl.offline.Learner`. None selects `cql`, and `iql` for a Box; with
            `resume`, None selects the algorithm of the run.
        seeds: Number of networks, which are trained in parallel. None selects 1; with `resume`,
            that of the run.
        seed: Seed of the first network; network k uses seed + k. None selects 0; with `resume`,
            that of the run.
        threads: Number of threads of PyTorch and of the reader.
        device: `cpu` or `cuda`.
        resume: Whether training continues from the checkpoints in `out`. A number of `updates`
            above that of the run continues the run to this number, also if it has finished.
        other_data: Whether `resume` accepts checkpoints trained on other data.
        only: Condition on the episodes to learn from, such as `"success == 1"`; see `select`. With
            `resume`, None without `mask` selects those of the run.
        mask: Names of labeled intervals, whose steps are not learned from; see `select`.
        ray: Whether Ray workers train, each of them one seed after the other; or the workers and
            the cluster. The result is that of one process. All workers must see the logs and `out`.
        progress: Function called with each row of metrics.
        **settings: Settings of the algorithm. Missing settings have the algorithm's defaults; with
            `resume`, they have the values of the run. Settings of `auto` are also its wall time
            `budget_minutes`, and `report`, the output folder of an HTML page on the choice.

    Returns:
        The list of the summaries of all seeds, which also has the `folder` and the `policy`.

    Raises:
        UnknownNameError: There is no such algorithm.
        UsageError: The algorithm has no such setting, there is no such device, a number is out of
            range, or the run to resume has other seeds.
        OutputExistsError: `out` contains a run.
        LogError: The logs cannot be read.
        SpaceError: The algorithm does not support the observations or actions.
        TrainingError: The loss is not finite, or `out` has a run with other data or settings.
        ClusterError: The Ray cluster cannot be used, or workers died repeatedly.
        MissingExtraError: The packages of the `offline` extra, or Ray, are not installed.
    """
    from mcaprl.offline.algorithms.registry import configured
    from mcaprl.offline.selection.config import AUTO, AutoConfig
    from mcaprl.offline.selection.race import select
    from mcaprl.offline.training.metrics import draw_curves
    from mcaprl.offline.training.train import train as train_dataset

    check_least(1, seeds=seeds, threads=threads)
    check_least(0, seed=seed)
    _refuse_arguments_of_open(settings)
    cluster = ray if isinstance(ray, ClusterOptions) else ClusterOptions(ray)
    cluster.check()
    out = Path(out)
    if resume:
        algo, settings = _resumed(out, algo, settings)
        if only is None and not mask:
            only, mask = _selection_of(out)
    numbers = choose_seeds(out, seeds, seed, resume)
    if algo == AUTO:
        check_settings(algo, AutoConfig, settings)
        chosen: AutoConfig | Algorithm = AutoConfig(**settings)
    else:
        chosen = configured(algo, settings, [AUTO])
    if algo == AUTO and (other_data or cluster.ray):
        raise UsageError(f"`{'other_data' if other_data else 'ray'}=` is not for `algo={algo!r}`")
    request: dict[str, Any] = {"resume": resume, "device": device, "progress": progress}
    with cluster.connected(), torch_threads(threads):
        dataset = opened(data, weighted=True, threads=threads)
        dataset = selected(dataset, only, as_names(mask))
        if not isinstance(chosen, AutoConfig):
            chosen = configured(algo, settings, space=dataset.action_space)
        if cluster.ray:
            from mcaprl.ray.tasks import train_on_ray

            request |= {"other_data": other_data, "threads": threads, "workers": cluster.workers}
            assert not isinstance(chosen, AutoConfig)
            summaries = train_on_ray(dataset, chosen, out.absolute(), seeds=numbers, **request)
        else:
            request |= {"seeds": len(numbers), "seed": numbers.start}
            if isinstance(chosen, AutoConfig):
                summaries = select(dataset, chosen, out, **request)[1]
            else:
                summaries = train_dataset(dataset, chosen, out, other_data=other_data, **request)
    if dataset.origin.mapping is not None:
        write_json(out / MAPPING_NAME, dataset.origin.mapping, TrainingError)
    if dataset.robot:
        write_json(out / ROBOT_NAME, dict(dataset.robot), TrainingError)
    with suppress(MissingExtraError):
        draw_curves(out)
    return Run(out, summaries)


def _refuse_arguments_of_open(settings: Mapping[str, Any]) -> None:
    for name in _OF_OPEN & settings.keys():
        raise UsageError(f"`{name}=` is an argument of mcaprl.open: pass what it returns as data")


def _resumed(
    out: Path, algo: str | type[Learner] | None, settings: Mapping[str, Any]
) -> tuple[str | type[Learner], dict[str, Any]]:
    """Return the algorithm and the settings of the run in `out`, with those that are given."""
    earlier = run_to_resume(out)
    check_kind(out, earlier, "offline")
    was: Any = earlier.get("algo", algo)
    if getattr(algo, "name", algo) not in (None, was):
        raise UsageError(
            f"{out} is a run of {was}: resume it without algo, or choose another folder"
        )
    return algo or was, {**settings_from_json(earlier.get("config")), **settings}


def _selection_of(out: Path) -> tuple[str | None, list[str]]:
    """Return `only` and `mask` of the run in a folder."""
    match run_to_resume(out):
        case {"source": {"only": str() | None as only, "mask": list(mask)}}:
            return only, [str(name) for name in mask]
    return None, []


def train_online(
    sim: str | None,
    out: str | Path,
    *,
    algo: str | None = None,
    engine: str | None = None,
    preset: str | None = None,
    seeds: int | None = None,
    seed: int | None = None,
    threads: int = 1,
    record: str | Path | None = None,
    upload: str | None = None,
    sources: str | Path | Sequence[str | Path] = (),
    resume: bool = False,
    live: bool = False,
    live_speed: float = DEFAULT_SPEED,
    port: int = DEFAULT_PORT,
    allow_origin: str | Sequence[str] = (),
    device: str | None = None,
    max_steps: int | None = None,
    observation: str | None = None,
    rules: str | None = None,
    actions: str | int | None = None,
    sim_options: Mapping[str, Any] | None = None,
    on_live: Callable[[LiveAddress], None] = lambda address: None,
    progress: ProgressCallback = lambda now: None,
    **settings: Any,
) -> Run[OnlineSummary]:
    """Train a policy in a sim; the same seed and machine produce the same curve.

    Args:
        sim: Short name of a sim, or a Gymnasium id; None for the sim of the preset or of the
            resumed run.
        out: Run folder to create.
        algo: `double-dqn` or `dqn` for discrete actions, `sac`, `td3` or `tqc` for those of a Box,
            `ppo` or `a2c` for both. None selects that of the preset or run, else `double-dqn` or
            `sac`.
        engine: `mcaprl`, whose learners are those of offline training, or `sb3` for
            Stable-Baselines3. None selects `mcaprl` for `double-dqn`, `sac` and `td3`.
        preset: Name of published settings.
        seeds: Number of agents, which are trained one after the other. None selects 1; with
            `resume`, that of the run.
        seed: Seed of the first agent; agent k uses seed + k. None selects 0; with `resume`, that of
            the run.
        threads: Number of threads of PyTorch.
        record: Output log of all transitions; with several seeds, a folder.
        upload: URL to which the log of `record` is copied at the end of the training; with several
            seeds, the URL of a folder.
        sources: Logs, and at most one policy whose weights initialize the agents. With discrete
            actions, the logs fill the replay buffer; else, a part of each batch is drawn from them,
            unless `data_fraction` is 0.
        resume: Whether training continues from the checkpoints in `out`.
        live: Whether viewers can connect during training, and watch one episode after the other.
        live_speed: Simulated seconds per second in the episodes that are shown.
        port: Port on 127.0.0.1 for viewers; 0 for any free port.
        allow_origin: Origin of other web pages that may connect, or a list of origins. Pages on
            this machine, Foxglove and Lichtblick may always connect.
        device: `cuda` or `cpu`, on which sims, replay buffers and networks of all seeds stay, and
            all seeds are trained at once; only for `double-dqn` in the sims `lane` and `racer`,
            without a recording. The settings have other defaults (`mcaprl.device.training`), and
            the last policy is saved instead of the best checkpoint. None trains one seed after the
            other.
        max_steps: Steps after which an episode is truncated, in training and evaluation. None
            selects that of the resumed run, else no limit in training, and 27,000 in evaluations of
            environments without a time limit.
        observation: Observation that the sim returns, such as `depth`.
        rules: Rules of the sim, such as `classic`.
        actions: Actions of the sim, such as `continuous`.
        sim_options: Other arguments of the environment.
        on_live: Function called with the address once viewers can connect.
        progress: Function called repeatedly during training.
        **settings: Settings of the algorithm. Missing settings have the defaults of the preset or
            the sim; with `resume`, they have the values of the run.

    Returns:
        The list of the summaries of all seeds, which also has the `folder` and the `policy`.

    Raises:
        UnknownNameError: There is no such sim, algorithm or preset.
        UsageError: No sim is given, the arguments contradict the preset, a number is out of range,
            or the run to resume has other seeds.
        OutputExistsError: `out` or `record` exists.
        SpaceError: The algorithm does not support the observations or actions.
        PolicyError: The policy in `sources` has another network than the agent.
        TrainingError: `out` cannot be written, or contains a run of another task.
        MissingExtraError: The packages of the `online` extra, or of `contrib` for `tqc`, are not
            installed.
    """
    from mcaprl.online.live import LiveTraining
    from mcaprl.online.task import choose_task
    from mcaprl.online.train import sources_to_resume
    from mcaprl.online.train import train as train_agents

    check_least(1, seeds=seeds, threads=threads, max_steps=max_steps)
    check_least(0, seed=seed)
    check_positive(live_speed=live_speed)
    check_port(port)
    if upload is not None:
        check_upload(upload, overwrite=resume)
        if record is None:
            raise UsageError("upload needs record: there is no log to copy")
    out = Path(out)
    options = all_options(observation, rules, actions, sim_options)
    if device is not None:
        if algo not in (None, "double-dqn"):
            raise UsageError(f"`device=` trains double-dqn only: omit `algo={algo!r}`")
        _check_device_request(
            engine=engine is not None,
            preset=preset is not None,
            record=record is not None,
            sources=bool(as_names(sources)),
            resume=resume,
            live=live,
            max_steps=max_steps is not None,
        )
        numbers = choose_seeds(out, seeds, seed, resume)
        found = _train_on_device(sim, out, device, numbers, threads, options, settings, progress)
        return Run(out, found)
    names = _absolute(as_names(sources))
    if resume and not names:
        names = sources_to_resume(out, choose_seeds(out, seeds, seed, resume))
    data, policy = _experience(names)
    task = choose_task(
        sim,
        algo,
        options,
        settings,
        preset=preset,
        max_steps=max_steps,
        engine=engine,
        resumed=out if resume else None,
        with_logs=data is not None,
        with_policy=policy is not None,
    )
    with ExitStack() as stack:
        stack.enter_context(torch_threads(threads))
        viewers = None
        if live:
            viewers = LiveTraining(
                task, port=port, origins=as_names(allow_origin), speed=live_speed
            )
            stream = stack.enter_context(closing(viewers)).stream
            on_live(LiveAddress(stream.app_url, stream.url, out / LAYOUT_NAME))
        trained = train_agents(
            task,
            out,
            seeds=seeds,
            seed=seed,
            record=record,
            data=data,
            policy=policy,
            sources=names,
            resume=resume,
            live=viewers,
            progress=progress,
        )
    if upload is not None and record is not None:
        folder = Path(record)
        upload_all(sorted(folder.glob("*.mcap")) if folder.is_dir() else [folder], upload)
    return Run(out, trained)


def _check_device_request(**given: bool) -> None:
    """Check that no argument is given that training on a device does not support."""
    for name, is_given in given.items():
        if is_given:
            raise UsageError(f"`{name}=` cannot be combined with `device=`: omit one of them")


def _train_on_device(
    sim: str | None,
    out: Path,
    device: str,
    seeds: range,
    threads: int,
    options: dict[str, Any],
    settings: dict[str, Any],
    progress: ProgressCallback,
) -> list[OnlineSummary]:
    from mcaprl.device.training import device_task
    from mcaprl.device.training import train as train_agents

    if sim is None:
        raise UsageError("`device=` needs a sim: lane or racer")
    task = device_task(sim, options, **settings)
    with torch_threads(threads):
        return train_agents(
            task, out, device=device, seeds=len(seeds), seed=seeds.start, progress=progress
        )


def _absolute(sources: list[str]) -> list[str]:
    """Return paths that do not depend on the working directory; URLs stay the same."""
    return [each if "://" in each else str(Path(each).absolute()) for each in sources]


def _experience(sources: list[str]) -> tuple[Dataset | None, list[Policy] | None]:
    """Return the dataset of the logs in `sources`, if any, and the policies of the run, if any."""
    policies = [source for source in sources if is_policy(Path(source))]
    if len(policies) > 1:
        raise UsageError(f"pass at most one policy to start from, not {' and '.join(policies)}")
    logs = [source for source in sources if source not in policies]
    return open_data(logs) if logs else None, load_policies(policies[0]) if policies else None


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
