"""The racing car with ray sensors, `mcaprl/Racer-v0`."""

from mcaprl.sims.spec import SimSpec

SPEC = SimSpec(
    name="racer",
    env_id="mcaprl/Racer-v0",
    continuous_id="mcaprl/RacerContinuous-v0",
    entry_point="mcaprl.sims.racer.env:RacerEnv",
    vector_entry_point="mcaprl.sims.racer.env:BatchedRacerEnv",
    device_entry_point="mcaprl.sims.racer.device:DeviceRacer",
    # Only the classic rules reach this limit; the default rules truncate after 1,000 steps.
    max_episode_steps=10_000,
    pilot="mcaprl.sims.racer.pilot:RacerPilot",
    engine="numba",
)
