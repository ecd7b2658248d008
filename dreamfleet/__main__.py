"""`python -m dreamfleet`: the command line."""

import sys

from dreamfleet.common.cli import main

sys.exit(main())
