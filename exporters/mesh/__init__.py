"""What is done to a mesh: fewer faces, a flat layout for its texture, rays onto it."""
