"""Images of a bag as observations."""
