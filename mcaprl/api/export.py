"""Export of a trained policy as one file for a robot."""

from __future__ import annotations

from pathlib import Path

from mcaprl.api.policies import TrainedPolicy, load_policy
from mcaprl.errors import OutputExistsError


def export(run: str | Path, out: str | Path, *, overwrite: bool = False) -> TrainedPolicy:
    """Write a trained policy as ONNX, which ONNX Runtime runs without this package.

    Inputs are the parts of the observation by their names in the log; outputs are `action` and
    `scores`.

    Args:
        run: Run folder, or folder of one seed.
        out: ONNX file to write.
        overwrite: Whether an existing file is replaced.

    Returns:
        The policy that was exported.

    Raises:
        OutputExistsError: `out` exists.
        PolicyError: There is no policy, or it cannot be exported.
        MissingExtraError: The packages of the `export` extra are not installed.
    """
    from mcaprl.offline.export import export_onnx

    out = Path(out)
    if out.exists() and not overwrite:
        raise OutputExistsError(f"{out} exists: choose another path, or pass --overwrite")
    policy = load_policy(run)
    export_onnx(policy, out)
    return policy
