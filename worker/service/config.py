"""Settings of a worker process."""

from dataclasses import dataclass

from dreamfleet.common.cli.config import option
from dreamfleet.common.errors import UsageError
from dreamfleet.common.protocol.keys import check_run_name, check_worker_name
from dreamfleet.common.protocol.messages import MAX_LEASES

MAX_RUNS = 64  # that a worker serves side by side


@dataclass(frozen=True)
class WorkerConfig:
    """Settings of a worker process; `UsageError` for values that do not fit together."""

    run: str | None = option(None, "name of the run (default: the only live one)")
    name: str | None = option(None, "name of this worker (default: the host's)")
    slots: int = option(0, "scoring processes; 0: one for each core")
    drain_timeout: float = option(30.0, "seconds that running episodes may take to finish after the first Ctrl-C")
    any: bool = option(False, "serve the live runs with the fewest slots, and the next ones when they are over")
    runs: int = option(4, "with --any: runs that it serves side by side, which share its slots; 1: one after another")
    lifetime: float = option(0.0, "leave after this many seconds, as on the first Ctrl-C; 0: never")
    slot_memory: int = option(
        2048, "MiB that a scoring process may hold; a larger one is replaced between jobs; 0: no limit"
    )
    torch_device: str = option(
        "", "dream on this torch device, such as cuda or cuda:1, with one slot unless slots says more; empty: in ONNX "
        "Runtime, on each slot's core (docs/how-to/gpu.md)", flag=False,
    )  # fmt: skip
    exit_when_done: bool = option(False, "leave when the run has ended or refuses this worker")
    coordinator_timeout: float = option(
        600.0, "with --exit-when-done: seconds without a coordinator after which it leaves, and exits with 1"
    )

    def __post_init__(self) -> None:
        if self.run is not None:
            check_run_name(self.run)
        if self.name is not None:
            check_worker_name(self.name)
        if self.any and self.run is not None:
            raise UsageError("--any and --run exclude each other")
        if self.any and self.exit_when_done:
            raise UsageError("--any takes the next run, and --exit-when-done leaves after one: give one of them")
        if not 1 <= self.runs <= MAX_RUNS:
            raise UsageError(f"--runs must be from 1 to {MAX_RUNS}, not {self.runs}")
        if not 0 <= self.slots <= MAX_LEASES:
            raise UsageError(f"--slots must be from 0 to {MAX_LEASES}, not {self.slots}")
        for name in ("drain_timeout", "lifetime", "slot_memory", "coordinator_timeout"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise UsageError(f"--{name.replace('_', '-')} must be a finite number, and not negative")
