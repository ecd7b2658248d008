"""What each kind of fault does to a world."""

from __future__ import annotations

import math
from collections.abc import Callable

from dreamfleet.common.protocol.messages import Result, ResultBatch
from dreamfleet.coordinator.run.run import BY_HAND
from dreamfleet.coordinator.service.control import DRAINING
from tests.simulation.coordinator import Coordinator
from tests.simulation.network import Effect
from tests.simulation.schedule import Fault
from tests.simulation.truth import STEPS
from tests.simulation.worker import UID, Worker
from tests.simulation.world import Pending, World

LEASE = 4.0  # seconds of silence after which each side of a connection gives the other up
Strike = Callable[[World, Fault], bool | None]  # `False`: it found nothing to disturb
STRIKES: dict[str, Strike] = {}


def strike(world: World, fault: Fault) -> None:
    """Let it happen; one that finds nothing to disturb is not counted."""
    kind, _, way = fault.kind.partition("_")
    if way in ("up", "down"):
        effect = Effect(kind, world.now + fault.seconds, fault.amount)
        world.links[_host(world, fault)].disturb("up" if way == "up" else "down", effect)
    elif STRIKES[fault.kind](world, fault) is False:
        return
    world.happened[fault.kind] += 1


def _kind(struck: Strike) -> Strike:
    """Register what the kind of fault of this name does."""
    STRIKES[struck.__name__] = struck
    return struck


def _of_worker(struck: Callable[[World, Fault, Worker], bool | None]) -> None:
    """Register what a kind of fault does to a worker that is there."""

    def of_worker(world: World, fault: Fault) -> bool | None:
        worker = _worker(world, fault)
        return False if worker is None else struck(world, fault, worker)

    STRIKES[struck.__name__] = of_worker


def _of_coordinator(struck: Callable[[World, Fault, Coordinator], bool | None]) -> None:
    """Register what a kind of fault does to a coordinator that is there."""

    def of_coordinator(world: World, fault: Fault) -> bool | None:
        return False if world.coordinator is None else struck(world, fault, world.coordinator)

    STRIKES[struck.__name__] = of_coordinator


@_kind
def cut_unnoticed(world: World, fault: Fault) -> None:
    """The connection ends, for less than any lease: neither side notices."""
    host = _host(world, fault)
    world.links[host].cuts += 1
    world.later(fault.seconds, _mend, world, host)


@_kind
def cut(world: World, fault: Fault) -> None:
    """The connection ends; the coordinator notices within `amount` seconds, the worker in half of that."""
    world.later(fault.amount / 2, world.lose_sight, _host(world, fault))
    if (worker := _worker(world, fault)) is not None:
        world.later(fault.amount, world.send_to_coordinator, worker.identity, "gone")
    cut_unnoticed(world, fault)


def _mend(world: World, host: int) -> None:
    world.links[host].cuts -= 1
    world.later(0.02, world.look, host)


@_of_worker
def lose_token(world: World, fault: Fault, worker: Worker) -> None:
    """One side alone sees the other vanish: the coordinator, or with a larger `amount` the worker, for a moment."""
    if fault.amount < 0.6:
        world.send_to_coordinator(worker.identity, "gone")
    else:
        world.look(_host(world, fault), blink=True)


@_of_worker
def late_token(world: World, fault: Fault, worker: Worker) -> None:
    """A departure that is reported `amount` seconds late, perhaps after the worker is back."""
    world.later(fault.amount, world.send_to_coordinator, worker.identity, "gone")


@_of_worker
def kill_worker(world: World, fault: Fault, _killed: Worker) -> None:
    """A process ends; its token vanishes `amount` later, before or after its last results have arrived."""
    world.end_worker(_host(world, fault), fault.amount, fault.seconds)


@_of_worker
def stop_worker(world: World, fault: Fault, worker: Worker) -> bool | None:
    """A process is suspended and goes on; if that takes longer than a lease, both sides notice."""
    if worker.stopped:
        return False
    worker.stopped = True
    if fault.seconds > LEASE:
        world.later(LEASE, world.send_to_coordinator, worker.identity, "gone")
    world.later(fault.seconds, _go_on, world, _host(world, fault), worker, fault.seconds > LEASE)
    return None


def _go_on(world: World, host: int, worker: Worker, parted: bool) -> None:
    if world.workers[host] is not worker:
        return
    worker.stopped = False
    worker.awake_since = world.now
    world._wakes.pop(host, None)
    if parted:
        world.look(host, blink=True)
    world.wake_worker(host, worker, world.now)


@_of_worker
def slow_worker(world: World, fault: Fault, worker: Worker) -> None:
    """Turns that begin now take longer, up to ten times."""
    worker.slowness = 1.0 + fault.amount
    world.later(fault.seconds, setattr, worker, "slowness", 1.0)


@_of_worker
def drain_worker(_world: World, _fault: Fault, worker: Worker) -> None:
    """Somebody presses Ctrl-C once."""
    worker.membership.stop()


@_of_worker
def fail(_world: World, fault: Fault, worker: Worker) -> None:
    """The next turns give an error instead of a fitness."""
    worker.failures += math.ceil(fault.amount)


@_of_coordinator
def kill_coordinator(world: World, fault: Fault, _life: Coordinator) -> None:
    """It ends after `amount` more steps of its turns: between any event, write, commit and message."""
    world.kill = Pending(int(fault.amount), fault.seconds, opening=False)


@_of_coordinator
def kill_at_opening(world: World, fault: Fault, _life: Coordinator) -> None:
    """It ends `amount` steps after it has opened the next generation."""
    world.kill = Pending(int(fault.amount), fault.seconds, opening=True)


@_of_coordinator
def stop_coordinator(world: World, fault: Fault, life: Coordinator) -> bool | None:
    """It stands still, as on a suspended host: what arrives waits, and the clock makes a jump."""
    if world.coordinator_stopped:
        return False
    world.coordinator_stopped = True
    world.later(fault.seconds, _continue_coordinator, world, life, fault.seconds > LEASE)
    return None


def _continue_coordinator(world: World, life: Coordinator, parted: bool) -> None:
    if world.coordinator is not life:
        return
    world.coordinator_stopped = False
    for host, worker in enumerate(world.workers):
        if parted and worker is not None:
            world.send_to_coordinator(worker.identity, "gone")
            world.look(host, blink=True)
    world._wakes.pop(-1, None)
    world.wake_coordinator(0.0)


@_of_coordinator
def leave(_world: World, _fault: Fault, life: Coordinator) -> None:
    """Somebody says `dreamfleet drain`: what runs is finished, then the coordinator leaves."""
    life.draining = True
    life.run.pause(DRAINING)


@_of_coordinator
def pause(world: World, fault: Fault, life: Coordinator) -> None:
    """Somebody says `dreamfleet pause`, and after a while `dreamfleet resume`."""
    life.run.pause(BY_HAND)
    world.later(fault.seconds, world.resume, life)


@_of_coordinator
def bar(world: World, fault: Fault, life: Coordinator) -> bool | None:
    """Somebody bars an honest host, so what it brought is recalled, and lets it in again."""
    host = _host(world, fault)
    if world.coordinator_stopped or world.is_silent or life.run.bar(f"w{host}"):
        return False
    world.wake_coordinator(0.0)
    world.later(fault.seconds, world.bar, host, False)
    return None


@_of_coordinator
def resume(_world: World, _fault: Fault, life: Coordinator) -> bool | None:
    """Somebody says `dreamfleet resume` of a run that is not paused: what failed is tried again."""
    if life.draining or life.run.state.paused is not None:
        return False
    life.run.resume()
    return None


@_kind
def stranger(world: World, fault: Fault) -> None:
    """A result that nobody asked for: of no job, or another fitness of one that counts already."""
    known = [digest for digest in world.disk.jobs if digest in world.disk.durable]
    unknown = bytes([int(fault.at * 100) % 256]) * 32
    digest = known[int(fault.at * 1000) % len(known)] if known and fault.amount > 1.0 else unknown
    worker = _worker(world, fault)
    # Where results are checked, a forger can have a worker barred in whose name it speaks: it is a stranger there.
    identity = "stranger/0badc0de" if worker is None or world.shape.verify else worker.identity
    result = Result(digest, 99.0, STEPS, 0.1, None, None)
    world.send_to_coordinator(identity, ResultBatch(run_uid=UID, incarnation=1, fingerprint="f", results=(result,)))


@_kind
def garble(world: World, fault: Fault) -> None:
    """The next batch names another seed than the one that the digest is of."""
    world.links[_host(world, fault)].garbled = True


def _host(world: World, fault: Fault) -> int:
    return fault.worker % world.shape.workers


def _worker(world: World, fault: Fault) -> Worker | None:
    return world.workers[_host(world, fault)]
