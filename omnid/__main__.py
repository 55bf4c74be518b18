"""`python -m omnid`."""

import sys

from omnid.cli import main

if __name__ == "__main__":
    sys.exit(main())
