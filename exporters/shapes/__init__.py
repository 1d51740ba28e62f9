"""The data that are exported: meshes, their colours and textures, crops, volumes."""
