"""The command line of vfr-play, and the rendering of frames into files."""
