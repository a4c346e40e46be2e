"""Reading of any robot's bag as a dataset, by a mapping of its topics."""
