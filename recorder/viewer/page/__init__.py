"""A page that shows the episodes of a log in a browser, without a network."""
