"""Reading logs into datasets of NumPy arrays."""
