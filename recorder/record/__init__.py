"""Recording: Gymnasium environments to rows of the log format."""
