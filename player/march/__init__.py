"""Ray marching in numpy: the specification, and what runs where numba is not installed."""
