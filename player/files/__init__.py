"""How files are opened, read and put in place: only regular files inside a folder, whole or not at all."""
