"""`python -m nesy` is the command line `nesy`."""

import sys

from nesy.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
