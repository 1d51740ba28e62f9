"""From rays to composited features: occupancy grid, samples, compositing, pictures."""
