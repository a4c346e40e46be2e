"""Series that the panels of a layout plot, as labels and message paths.

A message path, `/topic{field==value}.field[index]`, selects one number of each message. Array
slices are not used, because viewers join all elements of a slice into one line. The paths exclude
`final` records, which have neither an action nor a reward.
"""

from __future__ import annotations

from collections.abc import Sequence

from mcaprl.recorder.format.metadata import LogMetadata
from mcaprl.recorder.format.spaces import action_leaf, observation_leaves

MAX_SERIES = 24
"""Maximum number of series in a plot; further series are left out."""
STEPS = "/rl/step{final==false}"
EPISODE_VARIABLE = "episode"
"""Variable of a layout with the number of the episode that the viewer's user chooses."""
CHOSEN_REWARD = f"/rl/step{{episode==${EPISODE_VARIABLE}}}{{final==false}}.reward"
# Title of each group of similar numbers, and the suffixes of their telemetry names.
_GROUPS = {
    "offsets": ("offset_m", "distance_m"),
    "speeds": ("_m_s",),
    "angles": ("_rad",),
    "positions": ("_m",),
    "other numbers": ("",),
}


def telemetry_series(names: Sequence[str]) -> dict[str, str]:
    """Return the series of fields of `/telemetry`."""
    return {name: f"/telemetry.{name}" for name in names[:MAX_SERIES]}


def telemetry_groups(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Group the series of `/telemetry` by title, so that numbers of similar size share a plot.

    >>> telemetry_groups(["offset_m", "x_m"])
    {'offsets': {'offset_m': '/telemetry.offset_m'}, 'positions': {'x_m': '/telemetry.x_m'}}
    """
    groups: dict[str, list[str]] = {title: [] for title in _GROUPS}
    for name in names:
        title = next(title for title, ends in _GROUPS.items() if name.endswith(ends))
        groups[title].append(name)
    return {title: telemetry_series(found) for title, found in groups.items() if found}


def action_series(metadata: LogMetadata) -> dict[str, str]:
    """Return one series per component of an action, or one per value of a discrete action."""
    names = metadata.action_names()
    if names:
        taken = {
            name: f"/rl/step{{action=={value}}}{{final==false}}.action"
            for value, name in names.items()
        }
        return dict(list(taken.items())[:MAX_SERIES])
    leaf = action_leaf(metadata.action_space)
    suffixes = [f"[{index}]" for index in range(leaf.size)] if leaf.shape else [""]
    return {f"action{suffix}": f"{STEPS}.action{suffix}" for suffix in suffixes[:MAX_SERIES]}


def observation_series(metadata: LogMetadata) -> dict[str, str]:
    """Return a series per component of the vector observations, up to `MAX_SERIES`."""
    paths = {}
    for leaf in observation_leaves(metadata.observation_space):
        if leaf.encoding is not None:
            continue
        named = leaf.path == () and len(metadata.observation_names) == leaf.size
        for index in range(min(leaf.size, MAX_SERIES)):
            label = metadata.observation_names[index] if named else f"{leaf.name}[{index}]"
            suffix = f"[{index}]" if leaf.shape else ""
            paths[label] = f"{STEPS}.{leaf.name}{suffix}"
    return dict(list(paths.items())[:MAX_SERIES])
