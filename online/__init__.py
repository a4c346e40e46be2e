"""mcaprl.online."""
