"""Training runs: loop, checkpoints, metrics, run folders."""
