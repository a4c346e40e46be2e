"""Tests of the driving of robots."""
