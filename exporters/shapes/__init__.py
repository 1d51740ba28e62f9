"""What is exported: meshes, their colours and textures, crops, volumes."""
