"""Workers on every node of a Ray cluster: one a node, with a slot for each CPU that Ray has there.

python workers.py auto --connect tcp/coordinator.example:7447 --run night

What follows the cluster's address is for `dreamfleet worker`. Nodes that come later get one too; Ctrl-C and SIGTERM
drain them all. The nodes' environment needs dreamfleet[worker], and whatever file is named must lie on each of them.
"""

import argparse
import signal
import subprocess
from threading import Event

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from dreamfleet.common.host.processes import command

LOOK = 5.0  # seconds from one look at the cluster's nodes to the next


@ray.remote
class Scoring:
    """A worker of ours on the node where Ray puts this actor."""

    def __init__(self, slots: int, words: list[str]) -> None:
        self.process = subprocess.Popen(command("worker", "--slots", slots, *words))

    def drain(self) -> int:
        """Finish what runs, and leave; the exit code."""
        self.process.terminate()
        return self.process.wait()


def main() -> None:
    """Until Ctrl-C or SIGTERM."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cluster", help="its address, or auto")
    args, words = parser.parse_known_args()
    ray.init(address=args.cluster, log_to_driver=True)
    stopped = Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stopped.set())
    placed: dict[str, ray.actor.ActorHandle] = {}
    while True:
        nodes = {node["NodeID"]: int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["Alive"]}
        placed = {node: actor for node, actor in placed.items() if node in nodes}
        for node, cpus in nodes.items():
            if cpus and node not in placed:
                there = NodeAffinitySchedulingStrategy(node, soft=False)
                placed[node] = Scoring.options(num_cpus=cpus, scheduling_strategy=there).remote(cpus, words)
                print(f"a worker of {cpus} slots on node {node}", flush=True)
        if stopped.wait(LOOK):
            break
    print("draining", flush=True)
    ray.get([actor.drain.remote() for actor in placed.values()])


if __name__ == "__main__":
    main()
