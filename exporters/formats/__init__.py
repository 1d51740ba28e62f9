"""One file format a module: arrays in, bytes out, and the way back for comparison."""
