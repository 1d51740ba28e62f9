"""Kernels for the head's operations between its matrix products, in float32 or bfloat16."""
