"""Workers wherever a Dask cluster has its own: one in each Dask worker, with a slot for each of its threads.

python workers.py tcp://scheduler.example:8786 --connect tcp/coordinator.example:7447 --run night

What follows the scheduler is for `dreamfleet worker`. Dask workers that come later get one too; Ctrl-C and SIGTERM
drain them all. Their environment needs dreamfleet[worker], and whatever file is named must lie on their hosts.
"""

import argparse
import asyncio
import signal
import subprocess
from threading import Event

from distributed import Client, Worker, WorkerPlugin

from dreamfleet.common.host.parent_death import parent_death_command
from dreamfleet.common.host.processes import command


class Scoring(WorkerPlugin):
    """Starts a worker of ours beside Dask's, and drains it when the plugin is taken away or Dask's worker closes."""

    name = "dreamfleet"

    def __init__(self, words: list[str]) -> None:
        self.words = words

    def setup(self, worker: Worker) -> None:
        """In Dask's worker, as it begins or as the plugin comes."""
        self.process = subprocess.Popen(
            [*parent_death_command(), *command("worker", "--slots", worker.state.nthreads, *self.words)]
        )

    async def teardown(self, worker: Worker) -> None:  # noqa: ARG002 - as Dask calls it
        """What runs is finished first."""
        self.process.terminate()
        await asyncio.to_thread(self.process.wait)


def main() -> None:
    """Until Ctrl-C or SIGTERM."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scheduler", help="its address, or the path of a scheduler file")
    args, words = parser.parse_known_args()
    stopped = Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    found = {"address": args.scheduler} if "://" in args.scheduler else {"scheduler_file": args.scheduler}
    with Client(**found) as client:
        client.register_plugin(Scoring(words))
        print(f"workers beside {len(client.scheduler_info(n_workers=-1)['workers'])} of Dask's", flush=True)
        stopped.wait()
        print("draining", flush=True)
        client.unregister_worker_plugin(Scoring.name)


if __name__ == "__main__":
    main()
