"""What each worker did during the last minutes: one character a time slice, newest last. Pure.

`page/live.js` shows it.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from dreamfleet.common.client.status import WorkerStatus

STRETCH = 5.0  # seconds in a slice
LENGTH = 60  # characters: five minutes
UNKNOWN, LOST, SILENT, IDLE = " ", "x", "?", "."  # and 1 to 9: how fast, 9 being the fleet's fastest slot


@dataclass
class _Stretch:
    began: float
    states: dict[str, tuple[str, float]] = field(default_factory=dict)  # by worker: sign, or steps a second and slot


class Lanes:
    """The slices seen so far; a slice without an update is unknown."""

    def __init__(self) -> None:
        self._stretches: deque[_Stretch] = deque(maxlen=LENGTH)

    def update(self, workers: Sequence[WorkerStatus], now: float) -> None:
        """Record the workers' states at `now`, in seconds of any clock."""
        began = now - now % STRETCH
        if self._stretches:
            missing = round((began - self._stretches[-1].began) / STRETCH)
            for behind in range(min(missing, LENGTH) - 1, 0, -1):
                self._stretches.append(_Stretch(began - behind * STRETCH))
        if not self._stretches or self._stretches[-1].began < began:
            self._stretches.append(_Stretch(began))
        self._stretches[-1].states |= {each.worker: _sign_and_rate(each) for each in workers}

    def render(self, workers: Sequence[WorkerStatus]) -> list[str]:
        """The lane of each worker, `LENGTH` characters each."""
        fastest = max((rate for each in self._stretches for _, rate in each.states.values()), default=0.0)
        signs = [
            {worker: sign or str(max(round(9 * rate / fastest), 1)) for worker, (sign, rate) in each.states.items()}
            for each in self._stretches
        ]
        return ["".join(each.get(worker.worker, UNKNOWN) for each in signs).rjust(LENGTH) for worker in workers]


def _sign_and_rate(worker: WorkerStatus) -> tuple[str, float]:
    if worker.state != "present":
        return (SILENT if worker.state == "silent" else LOST), 0.0
    rate = worker.steps_per_second / max(worker.slots, 1)
    return ("", rate) if rate > 0 else (IDLE, 0.0)
