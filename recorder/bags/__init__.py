"""Reader for bags of any robot: each field of a topic becomes a column."""
