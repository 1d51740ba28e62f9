"""Posed pictures at the size at which they are trained on: held in memory if they are few, on the disk if
they are many."""
