"""vfr-play: its command line, and how frames are rendered into files."""
