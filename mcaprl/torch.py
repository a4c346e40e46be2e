"""PyTorch datasets: transitions and sequences from logs, in memory or as a stream.

loader = mcaprl.torch.TransitionDataset("logs/").loader(256, shuffle=True)
stream = mcaprl.torch.TransitionStream("logs/", batch_size=256)     # for data beyond the memory
"""

from mcaprl.offline.batches.loading import TransitionDataset
from mcaprl.offline.batches.stream import TransitionStream

__all__ = ["TransitionDataset", "TransitionStream"]

# Reprs and pickles use the public import paths.
TransitionDataset.__module__ = TransitionStream.__module__ = "mcaprl.torch"
