"""When a process that drives episodes counts as hung: it made no step for too long. Pages: tasks.md, protocol.md."""

from time import monotonic

STALL_SECONDS = 30.0  # without a step, after which an episode is given up (docs/how-to/troubleshooting.md)
FUNCTION_STALL_SECONDS = 600.0  # of one call of a function that is a task
START_LIMIT = 120.0  # seconds that a process may take to load task and world model; task_check.py has it too


class StallWatch:
    """Watches a count of steps; seconds for which this host was suspended do not count."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Count from now and from no step."""
        self._steps, self._since = 0, monotonic()

    def quiet_seconds(self, steps: int, now: float, gap: float) -> float:
        """Seconds since the number of steps changed; `gap` is for how many before `now` this host was suspended."""
        self._since += gap
        if steps != self._steps:
            self._steps, self._since = steps, now
        return now - self._since


def describe_stall(limit: float, *, is_ready: bool) -> str:
    """Why a process was killed that made no step for `limit` seconds, or was not ready for its first one."""
    return f"no step for {limit:g} s" if is_ready else f"not ready after {limit:g} s"
