"""Action masks of a dataset from its infos, or from another part of its observations."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mcaprl.actions import MASK_KEY, OBSERVATION_KEY, info_name
from mcaprl.errors import SpaceError, UnknownNameError
from mcaprl.recorder.dataset.transitions import Transitions
from mcaprl.recorder.format.metadata import LogMetadata


def with_mask(
    columns: Transitions, description: LogMetadata, source: str
) -> tuple[Transitions, LogMetadata]:
    """Add the flags of the allowed actions to the observations.

    Returns:
        The columns and metadata of Dict observations, whose part `observation` is the original one.
    """
    space = description.observation_space
    if isinstance(space, spaces.Dict) and MASK_KEY in space.spaces:
        raise SpaceError(f"the observations already have a part {MASK_KEY}: omit mask_from")
    name = info_name(source)
    flags = _part(columns, description, source) if name is None else _info(columns, name)
    if flags.ndim != 2 or not np.isin(flags, (0, 1)).all():
        raise SpaceError(f"{source} is no action mask: expected one flag (0 or 1) for each action")
    masked = spaces.Dict([(OBSERVATION_KEY, space), (MASK_KEY, spaces.MultiBinary(flags.shape[1]))])
    return (
        dataclasses.replace(columns, frames=(*columns.frames, flags.astype(np.int8))),
        dataclasses.replace(description, observation_space=masked, observation_names=()),
    )


def _part(columns: Transitions, description: LogMetadata, source: str) -> NDArray[Any]:
    names = {"/".join(leaf.path): k for k, leaf in enumerate(description.leaves) if leaf.path}
    if source not in names:
        raise UnknownNameError("part of the observation", source, names)
    return np.asarray(columns.frames[names[source]])


def _info(columns: Transitions, name: str) -> NDArray[Any]:
    """Return an info (F, A); all actions are allowed in terminal states without the info."""
    if name not in columns.infos:
        raise UnknownNameError("info", name, columns.infos)
    info = columns.infos[name]
    missing = np.ma.getmaskarray(info).reshape(len(info), -1).any(1)
    last = columns.first_frames + columns.lengths
    ends = columns.terminated[columns.first_steps + columns.lengths - 1]
    needed = np.ones(len(info), bool)
    needed[last[ends]] = False
    if (missing & needed).any():
        frame = int((missing & needed).argmax())
        raise SpaceError(
            f"the environment returned no info {name} with frame {frame}: it must return one with"
            " each observation, also in reset"
        )
    return np.where(missing.reshape(-1, *[1] * (info.ndim - 1)), 1, np.ma.getdata(info))
