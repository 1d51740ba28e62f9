"""The head as ONNX, built from weights and read out of an asset."""
