"""`mcaprl annotate`: what policies think of logged steps, or what there was to see, in a copy."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import click

from mcaprl.api.policies import policy_names, trained_policies
from mcaprl.cli.replay import sim_of
from mcaprl.cli.show import counted, progress
from mcaprl.errors import UsageError
from mcaprl.recorder.dataset.dataset import Dataset
from mcaprl.recorder.dataset.open import open_logs
from mcaprl.recorder.viewer.annotate import AnnotatedCopy, values_topics


@click.command()
@click.argument("file", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--policy", "policies", multiple=True, help="A trained run; may be given repeatedly.")
@click.option("--gamma", type=click.FloatRange(0, 1), help="Discount. [default: the run's]")
@click.option("--scene", is_flag=True, help="Step the sim again and add what there was to see.")
@click.option("--camera", is_flag=True, help="With --scene: metric depth images, too.")
@click.option("--sim", help="With --scene: step this sim instead of the one that the log names.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="File to write.")
@click.option("--overwrite", is_flag=True, help="Replace a file that is there.")
def annotate(
    file: Path,
    policies: tuple[str, ...],
    gamma: float | None,
    scene: bool,
    camera: bool,
    sim: str | None,
    out: Path,
    overwrite: bool,
) -> None:
    """Copy FILE and add to each step what a policy thinks of it, or what there was to see."""
    if not policies and not scene:
        raise UsageError("annotate needs --policy POLICY, --scene, or both")
    dataset = open_logs(file)
    topics = values_topics(list(policy_names(policies).values()))
    with AnnotatedCopy(file, out, overwrite=overwrite) as copy:
        for name, topic in zip(dict.fromkeys(policies), topics.values(), strict=True):
            copy.add_values(topic, _values(dataset, name, gamma))
            click.echo(f"{out}: {topic} has what {name} thinks of {len(dataset)} steps")
        if scene:
            with closing(sim_of(dataset, file, sim)) as env:
                found = copy.add_scene(dataset, env, camera=camera)
            episodes, steps = counted(found.episodes, "episode"), counted(found.steps, "step")
            click.echo(f"{out}: the scene of {episodes}, {steps}")


def _values(dataset: Dataset, name: str, gamma: float | None) -> list[tuple[Any, Any]]:
    """Each episode with what the first policy of a run thinks of it."""
    from mcaprl.offline.estimate.values import gamma_of_run, value_columns

    policy: Any = trained_policies(name, dataset)[0]
    discount = gamma_of_run(Path(name)) if gamma is None else gamma
    found = []
    with progress(f"asking {name}", len(dataset.episodes)) as advance:
        for episode in dataset.episodes:
            found.append((episode, value_columns(policy, episode, dataset.action_space, discount)))
            advance()
    return found
