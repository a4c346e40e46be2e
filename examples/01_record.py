"""Record an environment of your own, and look at the log as arrays.

python examples/01_record.py
"""

import gymnasium as gym
import numpy as np

import mcaprl


class Park(gym.Env):
    """A cart that accelerates left or right, and has to stop at 0."""

    observation_space = gym.spaces.Box(-10, 10, (2,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        """Start within 5 m of the target."""
        super().reset(seed=seed)
        self.position, self.speed = self.np_random.uniform(-5, 5), 0.0
        return self.observe(), {}

    def step(self, action):
        """Accelerate by -1, 0 or 1 for a tenth of a second."""
        self.speed += 0.1 * (int(action) - 1)
        self.position = np.clip(self.position + 0.1 * self.speed, -10, 10)
        stopped = abs(self.position) < 0.1 and abs(self.speed) < 0.2
        return self.observe(), 10.0 * stopped - 0.1 * abs(self.position), stopped, False, {}

    def observe(self):
        """Return position and speed."""
        return np.array([self.position, self.speed], np.float32)


env = gym.wrappers.TimeLimit(Park(), 200)
env = mcaprl.RecordMcap(env, "park.mcap", policy="noisy", overwrite=True)
random = np.random.default_rng(0)
for episode in range(50):
    observation, info = env.reset(seed=episode)
    ended = truncated = False
    while not (ended or truncated):
        # A controller that acts at random in 30 % of the steps.
        best = int(np.clip(np.rint(1 - observation[0] - 2 * observation[1]), 0, 2))
        action = random.integers(3) if random.random() < 0.3 else best
        env.behavior_prob = 0.1 + 0.7 * (action == best)
        observation, reward, ended, truncated, info = env.step(action)
env.close()

data = mcaprl.open("park.mcap")
print(data)
print(f"mean return {data.statistics.mean_return:.1f}, first actions {data.actions[:5]}")
