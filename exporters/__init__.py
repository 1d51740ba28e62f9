"""Files for other programs out of a baked asset: arrays in, bytes out. A library heavier than numpy is
imported by the function that needs it.

A room may import `player` and the rooms above it in this table, never one beside or below it:

| room | what is in it |
|---|---|
| `extras`, `progress`, `options` | optional packages; how far work is; what can be asked for |
| `shapes` | what is exported: meshes, colours, textures, crops, volumes |
| `mesh`, `formats`, `head` | what is done to a mesh; one file format a module; the head as ONNX |
| `surface` | how an asset's surface is found, and its colours |
| `pictures`, `pages`, `export_mesh` | the exports that are several files |
| `export` | every export |
| `cli` | the command `vfr-export` |
"""
