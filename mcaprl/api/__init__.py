"""The functions of the public API, one module per command; `mcaprl` exports them."""
