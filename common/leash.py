"""A command that ends with the process that asked for it: `python -m dreamfleet.common.leash PARENT COMMAND ...`.

Whoever is killed outright can end nothing that it started; what it started has to notice. Linux tells it, also behind
the `exec`; elsewhere the command runs on until it is done.
"""

from __future__ import annotations

import os
import sys

from dreamfleet.common.children import die_with


def main() -> None:
    """Become the command."""
    die_with(int(sys.argv[1]))
    os.execv(sys.argv[2], sys.argv[2:])  # noqa: S606 - our own interpreter and verb


if __name__ == "__main__":
    main()
