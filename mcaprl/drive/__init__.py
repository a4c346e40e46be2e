"""Driving of robots by policies that were trained from their bags."""
