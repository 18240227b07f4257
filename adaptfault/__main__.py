"""``python -m adaptfault`` is the command ``adaptfault``."""

import sys

from adaptfault.cli import main

if __name__ == "__main__":
    sys.exit(main())
