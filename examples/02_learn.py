# %% [markdown]
# # Learn a policy from a log
#
# The log has 300 episodes of CartPole with random actions. CQL learns from the log alone; CartPole
# itself is used only to record it, and to measure the policy at the end. Learning needs discrete
# actions.

# %%
from pathlib import Path
from tempfile import mkdtemp

import mcaprl

folder = Path(mkdtemp())
log, run = folder / "log.mcap", folder / "run"
mcaprl.record("CartPole-v1", log, policy="random", episodes=300, seed=1)
data = mcaprl.open(log)
print(data)
print(f"mean return of the log: {data.statistics.mean_return:.1f}")

# %% [markdown]
# The discount says how far ahead the policy looks. Random episodes are about 22 steps long, so 0.9,
# which looks about ten steps ahead, is enough.

# %%
runs = mcaprl.train(data, run, algo="cql", updates=1500, gamma=0.9, target_interval=100)
policy = mcaprl.load_policy(run)
print(policy.act(data.observations[:5]), data.actions[:5])

# %% [markdown]
# Each policy runs the same 20 episodes. The interval covers the episodes; with several training
# seeds (`seeds=4` in `train`) it covers the seeds, too.

# %%
evaluation = mcaprl.evaluate([run, "random"], "CartPole-v1", episodes=20)
for score in evaluation.policies:
    low, high = score.interval
    print(f"{score.policy}: {score.mean_return:.1f} ({low:.1f} to {high:.1f})")
