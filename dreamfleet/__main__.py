"""`python -m dreamfleet`, and the program `dreamfleet`: the command line."""

import signal
import sys


def main() -> int:
    """Run the command line. Until a verb runs, Ctrl-C ends the process at once: an import would print a traceback."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from dreamfleet.common.cli import command_line

    return command_line.main()


if __name__ == "__main__":
    sys.exit(main())
