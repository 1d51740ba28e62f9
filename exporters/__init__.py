"""Exports of a baked asset as files for other programs. Writers take arrays and return bytes. A library
heavier than numpy is imported inside the function that needs it.

A room (a module or folder of this package) may import `player` and the rooms in the rows above its own, never
another room of its own row or of a row below:

| room | what is in it |
|---|---|
| `extras`, `options` | optional packages; formats and settings |
| `shapes` | the data that are exported: meshes, colours, textures, crops, volumes |
| `mesh`, `formats`, `head` | operations on meshes; file formats, one per module; the head as ONNX |
| `surface` | extraction of an asset's surface, and its colours |
| `pictures`, `pages`, `export_mesh` | exports that may write several files |
| `export` | the function that runs any export |
| `cli` | the command `vfr-export` |
"""
