"""Datasets of NumPy arrays, read from logs."""
