"""Read and write files: only regular files are read, and a file is written as a whole or not at all."""
