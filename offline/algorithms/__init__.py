"""The offline algorithms, their losses and networks."""
