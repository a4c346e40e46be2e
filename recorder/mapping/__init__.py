"""Conversion of any robot's bag to a dataset. A mapping assigns the topics of the bag."""
