"""The sim `mcaprl/HighwayLane-v0`: the lane-keeping and racetrack environments of highway-env."""

from mcaprl.sims.spec import SimSpec

SPEC = SimSpec(
    name="highway-lane",
    env_id="mcaprl/HighwayLane-v0",
    continuous_id="mcaprl/HighwayLaneContinuous-v0",
    entry_point="mcaprl.sims.highway.env:HighwayLaneEnv",
    max_episode_steps=700,
    pilot="mcaprl.sims.highway.env:HighwayPilot",
    engine="highway_env",
)
