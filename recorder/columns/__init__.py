"""MCAP topics as NumPy columns, independent of reinforcement learning.

Reading: `reader` (summary, positions of messages), `topic` (columns), `cdr` (fields).
Writing: `writer` (chunks, top-level records), `output` (locked file; merges small chunks at
close), `summary` (also of a finished file).
Both: `records`, `chunks`. Damaged files: `summary` (checks), `salvage`.
"""
