"""Poses of coordinate frames, from the transforms of a bag."""
