"""Rollouts, evaluation, statistics and reports of policies in a sim."""
