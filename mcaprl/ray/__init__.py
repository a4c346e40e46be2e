"""Logs as datasets of Ray Data, on one machine or a cluster. Extra: `ray`.

rows = mcaprl.ray.read("logs/", columns=["observation", "action"])    # a ray.data.Dataset
mcaprl.ray.write(rows.filter(...), "selected/")                      # logs, and their manifest

`mcaprl.record`, `train`, `sweep` and `evaluate` use Ray with `ray=True`. Importing this
module does not import Ray.
"""

from typing import TYPE_CHECKING

from mcaprl.lazy import lazy_attributes

if TYPE_CHECKING:
    from mcaprl.ray.datasets import read, write

__all__ = ["read", "write"]

__getattr__ = lazy_attributes(__name__, {"mcaprl.ray.datasets": __all__})
