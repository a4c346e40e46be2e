"""`mcaprl export`: a trained policy as one file for a robot."""

from __future__ import annotations

from pathlib import Path

import click

import mcaprl
from mcaprl.cli.show import echo


@click.command()
@click.argument("run", metavar="RUN")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="ONNX file to write.")
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
def export(run: str, out: Path, overwrite: bool) -> None:
    """Write the policy of RUN, or of RUN/seed-K, as ONNX: observations in, actions out.

    Inputs are the parts of the observation by their names in the log; outputs are action and
    scores. ONNX Runtime runs the file without this package.
    """
    policy = mcaprl.export(run, out, overwrite=overwrite)
    echo(f"{out}: {policy.algo} policy {policy.name}, {out.stat().st_size / 1000:.0f} kB")
