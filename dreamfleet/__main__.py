"""`python -m dreamfleet`: the command line."""

import sys

from dreamfleet.common.cli.command_line import main

sys.exit(main())
