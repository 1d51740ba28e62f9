"""What is done to a mesh: fewer faces, a flat layout and a texture, rays onto it."""
