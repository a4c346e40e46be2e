"""The version, in one place: the package, its logs and its checkpoints all quote it."""

__version__ = "0.1.0"
