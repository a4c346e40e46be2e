"""Logs made of parts of other logs: joined, split, filtered by episodes, and cut by time."""
