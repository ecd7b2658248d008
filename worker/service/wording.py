"""What a worker says of itself: why it leaves, what it waits for, and whole commands with the flags that were given."""

from collections.abc import Callable, Sequence
from itertools import takewhile

from dreamfleet.common.client.client import SHOWN_RUNS
from dreamfleet.common.errors import DreamfleetError, RefusedError
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.printable import join_some, one_line, truncate
from dreamfleet.common.protocol.messages import MAX_REASON
from dreamfleet.common.transport.network import Network
from dreamfleet.worker.service.config import WorkerConfig

WAIT_LIMIT = 30.0  # seconds after which a worker says how to start a coordinator


def describe_failure(error: BaseException) -> str:
    """The reason of a worker that an error ends: what users see of it, and the class of an unexpected one."""
    text = one_line(str(error)[: 10 * MAX_REASON].encode(errors="replace").decode())
    return truncate(text if isinstance(error, DreamfleetError) else f"{type(error).__name__}: {text}", MAX_REASON)


def describe_refusal(error: RefusedError, typed: Sequence[str]) -> str:
    """A refusal, with the command that may be accepted: as it was `typed`, with the flag that was lacking.

    Nothing typed, as in a program: the command has that flag alone.
    """
    if error.flag is None or not typed:
        return str(error)
    return f"{error.text}: `{shell_command(*_with_flag(typed, *error.flag))}`"


def _with_flag(typed: Sequence[str], flag: str, value: str) -> tuple[str, ...]:
    """The words of a command with this value of a flag; the flag `--task` keeps its others."""
    kept, values, words = list[str](), list[str](), list(typed)
    while words:
        word, equals, own = words.pop(0).partition("=")
        if word != flag:
            kept.append(word + equals + own)
            continue
        following = [own] if equals else list(takewhile(lambda each: not each.startswith("--"), words))
        del words[: 0 if equals else len(following)]
        values += following
    return (*kept, flag, *(values if flag == "--task" else ()), value)


class WaitingText:
    """What a worker says while it waits for a coordinator: at once, and once more after `WAIT_LIMIT` seconds."""

    def __init__(self, config: WorkerConfig, network: Network, now: float, ended: str = "") -> None:
        """`ended`: how the last run ended."""
        self.ended = ended
        self._run, self._addresses, self._secured = config.run, network.connect, network.credentials is not None
        self._since = now
        self._has_begun = self._has_named_remedy = False

    def next(self, now: float, *, answered: bool, others: Callable[[], Sequence[str]] = tuple) -> str:
        """What to say now; empty: nothing.

        `answered`: something answers at the address, but serves no such run. `others` are the runs that it serves.
        """
        address = ", ".join(self._addresses)
        if not self._has_begun:
            self._has_begun = True
            if self.ended:
                awaited = f"run {self._run} to go on" if self._run else "the next run"
                return f"{self.ended}; waiting for {awaited} at {address}"
            awaited = (f"run {self._run}" if self._run else "a run") if answered else "a coordinator"
            names = join_some([each for each in others() if each != self._run], SHOWN_RUNS) if answered else ""
            there = f"; what is served there: {names}" if names else ""
            return f"waiting for {awaited} at {address}{there}"  # docs/how-to/troubleshooting.md
        if self.ended or self._has_named_remedy or now - self._since < WAIT_LIMIT:
            return ""
        self._has_named_remedy = True
        own = f" of run {self._run}" if self._run else ""
        # Not at once: most workers that are not answered began before their coordinator.
        revoked = "; if one serves there, this worker's join file was revoked" if self._secured and answered else ""
        return (
            f"no coordinator{own} at {address}; tried for {WAIT_LIMIT:.0f} s; start one by: {self._command(answered)}"
            f"{revoked}"
        )

    def _command(self, answered: bool) -> str:
        """The command that starts a coordinator where this worker looks for it."""
        run = ("--run", self._run) if self._run else ()
        flag = "--connect" if answered else "--listen"  # what answers is a router, or another run's coordinator
        join = ("--join", "FILE") if self._secured else ()
        return shell_command("coordinator", *run, flag, self._addresses[0], *join)
