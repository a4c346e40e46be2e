"""Damaged logs for tests: kills, failed writes, mutations, forged metadata and fuzzing."""
