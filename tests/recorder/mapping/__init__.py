"""Tests of the mapping of bags."""
