"""mcaprl.offline."""
