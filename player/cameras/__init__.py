"""Cameras, the files that hold them, and paths that join them."""
