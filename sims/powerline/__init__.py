"""The powerline drone, `mcaprl/Powerline-v0`."""
