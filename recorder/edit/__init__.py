"""Edits that create logs from parts of other logs: join, split, filter by episode, cut by time."""
