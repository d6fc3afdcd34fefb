"""python -m lightfield_gs: the command line."""

import sys

from lightfield_gs.cli import main

if __name__ == "__main__":
    sys.exit(main())
