"""Validation and recovery of logs."""
