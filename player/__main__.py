"""`python -m player` is `vfr-play`."""

import sys

from player.app.cli import main

if __name__ == "__main__":
    sys.exit(main())
