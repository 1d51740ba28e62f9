"""Reduce the stored detail to what the pictures need."""
