"""Tests of mappings, which convert bags to datasets."""
