"""Cameras, canvases and rendered views shared by the sims."""
