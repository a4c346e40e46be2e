"""The drone along a power line, `mcaprl/Powerline-v0`."""

from mcaprl.sims.spec import SimSpec

SPEC = SimSpec(
    name="powerline",
    env_id="mcaprl/Powerline-v0",
    continuous_id="mcaprl/PowerlineContinuous-v0",
    entry_point="mcaprl.sims.powerline.env:PowerlineEnv",
    vector_entry_point="mcaprl.sims.powerline.env:BatchedPowerlineEnv",
    max_episode_steps=400,
    pilot="mcaprl.sims.powerline.pilot:PowerlinePilot",
    engine="numba",
)
