"""The functions that the commands call, each documented under its public name in `mcaprl`."""
