"""Tests of the reading of bags."""
