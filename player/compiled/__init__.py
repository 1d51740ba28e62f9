"""The march of a ray, compiled by numba, and how compiled code is made, kept and checked for."""
