"""mcaprl.cli."""
