"""Measures this package beside others': `make bench`."""
