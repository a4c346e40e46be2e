# %% [markdown]
# # Is the policy better? From the log alone
#
# Without a simulator, off-policy estimators weight the logged episodes by how likely the new policy
# makes them. An estimate is worth something only if the log contains enough of what the policy
# would do; its verdict says so.

# %%
from pathlib import Path
from tempfile import mkdtemp

import mcaprl

folder = Path(mkdtemp())
log, run = folder / "log.mcap", folder / "run"
mcaprl.record("CartPole-v1", log, policy="random", episodes=1000, seed=1)
train, test = mcaprl.open(log).split(0.5, seed=0)
runs = mcaprl.train(train, run, algo="cql", updates=1500, gamma=0.9, target_interval=100)


# %%
def show(epsilon):
    """Print the estimates of the policy with this probability of a random action."""
    found = mcaprl.estimate(run, test, gamma=0.9, epsilon=epsilon, updates=500)
    print(f"policy of the log: {found.behavior_return:.2f}")
    for one in found.estimates:
        interval = "" if one.interval is None else "{:.2f} to {:.2f}".format(*one.interval)
        print(f"{one.estimator:6} {interval:16} {one.verdict}")


# %% [markdown]
# A policy that takes the learned action in 40 % of the steps, and a random one otherwise, is close
# enough to the log. It is better than the policy of the log if its interval is above that policy's
# value.

# %%
show(epsilon=0.6)

# %% [markdown]
# The greedy policy is too different: about one random episode in a million agrees for 20 steps.
# All estimates are refused, although some of their intervals look narrow. Do not use a number
# beside a refusal.

# %%
show(epsilon=0.0)
