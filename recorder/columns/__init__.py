"""MCAP topics as NumPy columns, independent of reinforcement learning.

Reading: `reader` (summary, positions of messages), `topic` (columns), `decoder` and `cdr` (fields).
Writing: `writer` (chunks, top-level records), `output` (file; merges small chunks at
close), `summary` (also of a finished file), `file_lock`, `signals`.
Both: `records`, `chunks`, `message_rows`. Damaged files: `file_check`, `salvage`.
"""
