"""Operations on meshes: simplification, texture layout and painting, ray casting."""
