"""The lane-keeping car, `mcaprl/LaneKeeping-v0`."""
