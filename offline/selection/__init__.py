"""Choice of an algorithm and its settings from the log alone."""
