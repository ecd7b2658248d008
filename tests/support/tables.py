"""What verbs print as a table."""

import re


def cells(line):
    """The cells of a printed row that has no empty ones between others."""
    return re.split(r"\s{2,}", line.strip())
