"""MCAP topics as NumPy columns: records, chunks, indexes, CRCs and CDR.

Nothing in here knows reinforcement learning.
"""
