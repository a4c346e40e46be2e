"""Suggestion of a mapping file, from the messages of a bag."""
