"""A check of what a set of pictures is good for, before minutes are spent on training."""
