"""Turn a trained field into an asset: the visible part of the field in few bytes, the head as ONNX, and the
surface as a mesh."""
