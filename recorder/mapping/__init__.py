"""Conversion of any robot's bag to a dataset, with a mapping from topics to transitions."""
