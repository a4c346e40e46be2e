"""Checking and recovering whole logs."""
