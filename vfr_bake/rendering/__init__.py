"""Rendering: from rays to samples, composited features and pictures, guided by an
occupancy grid or proposals."""
