"""`mcaprl export`: a trained policy as one file for a robot."""

from __future__ import annotations

from pathlib import Path

import click

from mcaprl.errors import OutputExistsError


@click.command()
@click.argument("run", metavar="RUN")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="ONNX file to write.")
@click.option("--overwrite", is_flag=True, help="Replace a file that is there.")
def export(run: str, out: Path, overwrite: bool) -> None:
    """Write the policy of RUN, or of RUN/seed-K, as ONNX: observations in, actions out.

    Inputs are the parts of the observation by their names in the log; outputs are action and
    scores. ONNX Runtime runs it without this package.
    """
    from mcaprl.api.policies import load_policy
    from mcaprl.offline.export import export_onnx

    if out.exists() and not overwrite:
        raise OutputExistsError(f"{out} exists: choose another name, or --overwrite")
    policy = load_policy(run)
    export_onnx(policy, out)
    click.echo(f"{out}: {policy.algo} policy {policy.name}, {out.stat().st_size / 1000:.0f} kB")
