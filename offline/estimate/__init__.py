"""The value of a policy, estimated from a log alone."""
