"""The ray-cast racer, `mcaprl/Racer-v0`."""
