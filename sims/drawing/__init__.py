"""Scene descriptions, cameras, canvases and rendered views that the sims share."""
