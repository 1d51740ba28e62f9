"""The march and the work around it, compiled by numba, and the vectors that compiled code is written in."""
