"""Version of the package, also stored in logs and checkpoints."""

__version__ = "0.1.0"
