"""The lane-keeping car, `mcaprl/LaneKeeping-v0`."""

from mcaprl.sims.spec import SimSpec

SPEC = SimSpec(
    name="lane",
    env_id="mcaprl/LaneKeeping-v0",
    continuous_id="mcaprl/LaneKeepingContinuous-v0",
    entry_point="mcaprl.sims.lane.env:LaneKeepingEnv",
    vector_entry_point="mcaprl.sims.lane.env:BatchedLaneKeepingEnv",
    device_entry_point="mcaprl.sims.lane.device:DeviceLane",
    max_episode_steps=400,
    pilot="mcaprl.sims.lane.pilot:LanePilot",
    engine="numba",
)
