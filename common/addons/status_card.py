"""A live run in a notebook: a card of its status that is replaced in place, as plain HTML without scripts.

Pages: python.md.
"""

from collections.abc import Iterable, Sequence
from html import escape

from dreamfleet.common.client.run_view import LiveRunView
from dreamfleet.common.client.status import Status, WorkerStatus
from dreamfleet.common.printable import format_number, one_line, plural, truncate
from dreamfleet.common.protocol.function_values import fitness_word
from dreamfleet.common.runs.records import StoredGeneration, in_values

MOST_WORKERS = 12  # in the card
LONGEST = 160  # characters of a text in the card
WIDTH, HEIGHT, LEFT, BOTTOM = 560, 120, 64, 18  # of the chart, pixels; room for its labels
MARGIN = 8
LINE = "rgba(128,128,128,.45)"
CARD = f"font:14px/1.5 system-ui,sans-serif;max-width:600px;border:1px solid {LINE};border-radius:8px;padding:10px 16px"
BAR = "height:6px;border-radius:3px;overflow:hidden;background:rgba(128,128,128,.25);margin:4px 0 8px"
TABLE = "font:inherit;border-collapse:collapse;background:none"
CELL = "text-align:left;padding:1px 16px 1px 0;font-weight:normal"


def show_live(statuses: Iterable[Status]) -> bool:
    """Show each status in the place of the one before, in a notebook's cell; elsewhere print a line of each.

    Interrupting it ends the showing and not the run. Returns whether there was any status.
    """
    try:
        from IPython.core.getipython import get_ipython
        from IPython.display import display
    except ModuleNotFoundError:
        shell = None
    else:
        shell = get_ipython()
    place, any_shown = None, False
    try:
        for status in statuses:
            any_shown = True
            if shell is None:
                print(repr(status), flush=True)  # noqa: T201 - a terminal has no card
            elif place is None:
                place = display(status, display_id=True)  # type: ignore[no-untyped-call]
            else:
                place.update(status)
    except KeyboardInterrupt:
        return True
    return any_shown


def status_card(status: Status) -> str:
    """The card: state, progress, the fitness of the last generations, and workers."""
    task, view = status.settings.task, LiveRunView.of_status(status)
    shown = [in_values(each, task) for each in status.recent]
    share = 1.0 if status.is_over else view.eta.share or 0.0
    known, kind = view.facts, "confirmed" if view.confirmed else "best evaluation"
    state = str(known["state"])
    doing = plural(status.generations, "generation") if status.is_over else view.progress
    now = [] if status.is_over else [view.speed, view.eta.description]
    facts = [doing, *now, f"{kind} {known[kind]}" if view.reported else ""]
    return (
        f'<div style="{CARD}"><div><b>{_text(status.run)}</b> · {_text(task.task)}'
        f'<span style="float:right">{_text(state)}</span></div>'
        f"<div>{' · '.join(_text(each) for each in facts if each)}</div>"
        f'<div style="{BAR}"><div style="height:100%;width:{share:.1%};background:#2a9d8f"></div></div>'
        f"{fitness_chart(shown, fitness_word(task))}{_workers(view)}</div>"
    )


def fitness_chart(generations: Sequence[StoredGeneration], word: str = "fitness") -> str:
    """The average fitness of these generations as a line, between the worst and the best of each, as inline SVG."""
    if len(generations) < 2:
        return f'<div style="opacity:.7">the {word} is drawn from the second closed generation on</div>'
    ends = [end for each in generations for end in (each.worst, each.best)]
    low, high = min(ends), max(ends)
    first, last = generations[0].number, generations[-1].number

    def place(number: int, value: float) -> str:
        x = LEFT + (WIDTH - LEFT - MARGIN) * (number - first) / (last - first)
        y = MARGIN + (HEIGHT - BOTTOM - 2 * MARGIN) * (high - value) / ((high - low) or 1.0)
        return f"{x:.1f},{y:.1f}"

    line = " ".join(place(each.number, each.mean) for each in generations)
    band = [place(each.number, each.best) for each in generations]
    band += [place(each.number, each.worst) for each in reversed(generations)]
    label = 'font-size="11" fill="currentColor" opacity=".75"'
    bottom = HEIGHT - BOTTOM - MARGIN
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" style="width:100%;max-width:{WIDTH}px;display:block" role="img" '
        f'aria-label="{word} over generations"><polygon points="{" ".join(band)}" fill="#2a9d8f" opacity=".2"/>'
        f'<polyline points="{line}" fill="none" stroke="#2a9d8f" stroke-width="2"/>'
        f'<line x1="{LEFT}" y1="{MARGIN}" x2="{LEFT}" y2="{bottom}" stroke="currentColor" opacity=".4"/>'
        f'<text x="{LEFT - 5}" y="{MARGIN + 8}" text-anchor="end" {label}>{_text(format_number(high))}</text>'
        f'<text x="{LEFT - 5}" y="{bottom}" text-anchor="end" {label}>{_text(format_number(low))}</text>'
        f'<text x="{LEFT}" y="{HEIGHT - 4}" {label}>generation {first:,}</text>'
        f'<text x="{WIDTH - MARGIN}" y="{HEIGHT - 4}" text-anchor="end" {label}>{last:,}</text>'
        f'<text x="{(LEFT + WIDTH) / 2}" y="{HEIGHT - 4}" text-anchor="middle" {label}>'
        f"{word}: average, worst to best</text></svg>"
    )


def _workers(view: LiveRunView) -> str:
    status = view.status
    present = [each for each in status.worker_list if each.state in ("present", "silent")]
    rows = "".join(map(_worker, present[:MOST_WORKERS]))
    more = status.workers.present - min(len(present), MOST_WORKERS)
    head = f"{view.workers}, {view.slots}"
    return (
        f'<div style="margin-top:6px">{_text(head)}</div><table style="{TABLE}">{rows}</table>'
        f"{f'<div>and {more} more</div>' if more > 0 and present else ''}"
    )


def _worker(worker: WorkerStatus) -> str:
    cells = (
        worker.name, plural(worker.slots, "slot"), f"{plural(worker.finished, 'job')} finished",
        f"{worker.steps_per_second:,.0f} steps/s", "" if worker.state == "present" else worker.state,
    )  # fmt: skip
    columns = "".join(f'<td style="{CELL}">{_text(cell)}</td>' for cell in cells)
    return f"<tr>{columns}</tr>"


def _text(text: str) -> str:
    return escape(truncate(one_line(text), LONGEST))
