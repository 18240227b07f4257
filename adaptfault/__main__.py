"""``python -m adaptfault`` is the command ``adaptfault``."""

import sys

from adaptfault.cli import main

sys.exit(main())
