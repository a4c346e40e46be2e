"""Tests that read bags."""
