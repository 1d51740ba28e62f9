"""What the head computes between its matrix products, in float32 or bfloat16."""
