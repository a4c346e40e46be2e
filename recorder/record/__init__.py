"""Wrappers that record Gymnasium environments to MCAP logs."""
