"""Cameras, the files that hold them, and camera paths through a few views."""
