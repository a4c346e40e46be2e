"""MCAP topics as NumPy columns, independent of reinforcement learning.

Reading: `reader` (summary, positions of messages), `topic` (columns), `decoder` and `cdr` (fields).
Writing: `writer` (chunks, top-level records), `output` (file), `compact` (merges small chunks at
close), `append` (state of a finished file), `summary`, `file_lock`, `signals`.
Both: `records`, `chunks`, `message_rows`, `checksum`. Damaged files: `file_check`, `salvage`.
"""
