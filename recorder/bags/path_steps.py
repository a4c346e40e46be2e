"""Paths of fields in messages.

The path of a field is a sequence of steps: `twist.linear.x`, `points[0].positions`. A step is the
name of a field or the key of a map (`values[left]`, in quotes if it contains other characters:
`values["a.b"]`), an index of an array (`[3]`, `[-1]`), or a slice (`[0:12]`, `[::10]`, `[:]` or
`[]`). The steps after `slice.name` apply to each selected element: `motors[0:12].q` is the vector
of the `q` of twelve motors. An index directly after a slice selects one of the selected elements.
`PATH[@]` is the list of the names of the elements of `PATH`; see `values.names_of`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import lru_cache

from mcaprl.errors import UsageError

Step = str | int | slice
"""Name of a field or key of a map, index, or slice."""

NAMES = "[@]"
"""Suffix of the path of the names of a field's elements."""
_MAX_STEPS = 64
# A name, or brackets with a quoted key or anything else.
_STEP = re.compile(r"""\.?([^.\[\]]+)|\[(?:"([^"]*)"|'([^']*)'|([^\[\]]*))\]""")
_SLICE = re.compile(r"(-?\d{0,18}):(-?\d{0,18})(?::(-?\d{0,18}))?")
_INDEX = re.compile(r"-?\d+")
_INDEX_DIGITS = 18


@lru_cache(maxsize=1024)
def steps_of(path: str) -> tuple[Step, ...]:
    """Parse the path of a field."""
    steps: list[Step] = []
    place = 0
    while place < len(path):
        match = _STEP.match(path, place)
        # A dot is between a step and a name, and nowhere else.
        if match is None or (match[1] is not None and (path[place] == ".") != bool(steps)):
            raise UsageError(f"'{path[:200]}' is not a path of a field, see '{path[place:][:20]}'")
        steps.append(_step(match))
        place = match.end()
    if len(steps) > _MAX_STEPS:
        raise UsageError(f"'{path[:40]}...' has {len(steps)} steps; at most {_MAX_STEPS}")
    return tuple(steps)


def _step(match: re.Match[str]) -> Step:
    name, quoted, other, text = match.groups()
    for key in (name, quoted, other):
        if key is not None:
            return str(key)
    if _INDEX.fullmatch(text):
        if len(text.lstrip("-")) > _INDEX_DIGITS:
            raise UsageError(f"the index [{text[:20]}...] has {len(text)} digits")
        return int(text)
    if not text:
        return slice(None)
    found = _SLICE.fullmatch(text)
    if found is None:
        return str(text)
    numbers = [int(part) if part else None for part in found.groups()]
    if numbers[2] == 0:
        raise UsageError(f"[{text}]: the step of a slice cannot be 0")
    return slice(*numbers)


def path_text(steps: Sequence[Step]) -> str:
    """Return the steps as a path; the inverse of `steps_of`."""
    found = ""
    for step in steps:
        if isinstance(step, slice):
            parts = [step.start, step.stop, *([step.step] if step.step else [])]
            found += f"[{':'.join('' if part is None else str(part) for part in parts)}]"
        elif isinstance(step, int):
            found += f"[{step}]"
        elif not step or re.search(r"[.\[\]]", step):
            quote = "'" if '"' in step else '"'
            found += f"[{quote}{step}{quote}]"
        else:
            found += f"{'.' if found else ''}{step}"
    return found


def is_mapped(steps: Sequence[Step], number: int) -> bool:
    """Return whether a step is a slice, and the steps after it apply to each element."""
    after = steps[number + 1 : number + 2]
    return isinstance(steps[number], slice) and bool(after) and isinstance(after[0], str)


def general_path(path: str) -> str:
    """Return a path as it is in `TopicInfo.fields`: `motors[].q` for `motors[3].q`."""
    steps = list(steps_of(path.removesuffix(NAMES)))
    while steps and not isinstance(steps[-1], str):
        steps.pop()
    found = ""
    for step in steps:
        found += f"{'.' if found else ''}{step}" if isinstance(step, str) else "[]"
    return found


def kind_at(fields: Mapping[str, str], path: str) -> str:
    """Return the kind of the values of a path by `TopicInfo.fields`; empty if unknown.

    The kind of a field in the elements of arrays has a `[]` for each of these arrays.
    """
    steps = steps_of(path)
    are_several = any(is_mapped(steps, number) for number in range(len(steps)))
    if path.endswith(NAMES) or are_several or not steps or not isinstance(steps[-1], str):
        return ""
    general = general_path(path)
    return fields.get(general, "").removesuffix("[]" * general.count("[]"))
