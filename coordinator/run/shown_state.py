"""A run's state as the status and the replies about batches show it: a word, and why."""

from typing import NamedTuple

from dreamfleet.common.protocol.stop_kind import PauseKind
from dreamfleet.coordinator.run.run import Run
from dreamfleet.coordinator.run.run_state import Ended

WAITS_FOR_WORKERS, WAITS_FOR_BATCH = "waiting for workers", "waiting for a batch"  # prometheus.py, status_panel.py


class ShownState(NamedTuple):
    """A state in a word, which `live.js` knows, and why a run is paused or has ended; `why` is empty in other states.

    `pauses` is what paused it, the latest first; empty where the journal or differing hosts make it wait.
    """

    word: str
    why: str = ""
    pauses: tuple[PauseKind, ...] = ()


def shown_state(run: Run) -> ShownState:
    """How the run's state is shown. An end that is not yet written is shown as a pause."""
    if isinstance(run.state, Ended):
        return ShownState("ended", run.state.reason.text)
    if (paused := run.state.paused) is not None:
        return ShownState("paused", paused.text, tuple(each.kind for each in paused.pauses))
    if (stalled := run.state.stalled) is not None:
        return ShownState("paused", stalled.why)
    if not run.fleet.has_workers:
        return ShownState(WAITS_FOR_WORKERS)
    if (why := run.verification.waiting) and not any(each.takes_jobs for each in run.fleet.members.values()):
        return ShownState("paused", why)
    if not run.generation.population:
        return ShownState(WAITS_FOR_BATCH)
    return ShownState("evaluating" if run.fleet.drain_background else "running")
