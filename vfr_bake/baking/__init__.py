"""From a trained field to an asset: what is seen, stored in few bytes, with the head as ONNX and the surface
as a mesh."""
