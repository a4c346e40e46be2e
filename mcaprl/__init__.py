"""The robot's log is the dataset: record, learn from and replay MCAP files."""

from mcaprl._version import __version__

__all__ = ["__version__"]
