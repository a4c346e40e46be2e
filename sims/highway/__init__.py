"""The roads of highway-env, `mcaprl/HighwayLane-v0`."""
