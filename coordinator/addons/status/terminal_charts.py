"""Charts of terminal characters: a curve as bars, a share as a bar, candidates as cells. No input or output."""

from collections.abc import Sequence
from math import ceil

from rich.text import Text

from dreamfleet.common.client.status import Candidate, Population

EIGHTHS = " ▁▂▃▄▅▆▇█"
WAITING, FAILED = "·", "x"


def bar_chart(values: Sequence[float], rows: int) -> list[str]:
    """A bar for each value, `rows` lines high, the top line first; the smallest value is one eighth of a line high."""
    low, high = min(values), max(values)
    span = high / 2 - low / 2  # halves: the difference may overflow
    heights = [1 + (round((each / 2 - low / 2) / span * (8 * rows - 1)) if span > 0 else 0) for each in values]
    return ["".join(EIGHTHS[min(max(each - 8 * row, 0), 8)] for each in heights) for row in reversed(range(rows))]


def share_bar(share: float, width: int) -> str:
    """A share from 0 to 1 as a bar of `width` columns."""
    done = round(min(max(share, 0.0), 1.0) * width)
    return "━" * done + "╌" * (width - done)


def candidate_grid(population: Population, width: int, lines: int) -> list[Text]:
    """A cell for each candidate, or for several if there are too many; the best one so far is highlighted.

    A cell whose candidates all failed has its own sign. At most `lines` lines of at most `width` columns.
    """
    found = population.candidates
    group_size = max(1, ceil(len(found) / (width * lines)))
    best = max((each for each in found if each.fitness is not None), key=lambda each: each.fitness or 0.0, default=None)
    groups = (found[start : start + group_size] for start in range(0, len(found), group_size))
    cells = [_cell(group, best) for group in groups]
    return [Text.assemble(*cells[start : start + width]) for start in range(0, len(cells), width)]


def candidate_grid_height(population: Population, width: int) -> int:
    """The number of lines at which each candidate has its own cell."""
    return max(1, ceil(len(population.done) / width))


def _cell(group: Sequence[Candidate], best: Candidate | None) -> tuple[str, str]:
    done, wanted = sum(each.done for each in group), sum(each.wanted for each in group)
    if all(each.has_failed for each in group):
        return FAILED, "red"
    if not done:
        return WAITING, "dim"
    filled = EIGHTHS[min(max(1, done * 8 // max(wanted, 1)), 8)]
    return filled, "bold yellow" if best in group else "green" if done >= wanted else "cyan"
