"""What each kind of fault does to a world."""

from __future__ import annotations

import math
from collections.abc import Callable

from dreamfleet.common.protocol.messages import Result, ResultBatch
from dreamfleet.coordinator.run.run import BY_HAND
from dreamfleet.coordinator.service.control import DRAINING
from tests.simulation.network import Effect, Way
from tests.simulation.schedule import Fault
from tests.simulation.truth import STEPS
from tests.simulation.worker import UID, Worker
from tests.simulation.world import Pending, World

LEASE = 4.0  # seconds of silence after which each side of a connection gives the other up


def strike(world: World, fault: Fault) -> None:
    """Let it happen; one that finds nothing to disturb is not counted."""
    fault_of = _STRIKES.get(fault.kind)
    if fault_of is None:
        kind, _, way = fault.kind.partition("_")
        assert way in ("up", "down"), f"no fault is called {fault.kind}"
        struck = _message(world, fault, kind, "up" if way == "up" else "down")
    else:
        struck = fault_of(world, fault)
    world.happened[fault.kind] += struck


def _message(world: World, fault: Fault, kind: str, way: Way) -> bool:
    """For `seconds`, messages are lost, doubled (the second `amount` later), late, or out of order by `amount`."""
    world.links[_host(world, fault)].disturb(way, Effect(kind, world.now + fault.seconds, fault.amount))
    return True


def _cut(world: World, fault: Fault) -> bool:
    """The connection ends; the coordinator notices within `amount` seconds, the worker in half of that."""
    host, worker = _host(world, fault), _worker(world, fault)
    world.links[host].cuts += 1
    world.later(fault.amount / 2, world.lose_sight, host)
    if worker is not None:
        world.later(fault.amount, world.send_to_coordinator, worker.identity, "gone")
    world.later(fault.seconds, _mend, world, host)
    return True


def _cut_unnoticed(world: World, fault: Fault) -> bool:
    """Like a cut, but shorter than any lease: neither side notices."""
    host = _host(world, fault)
    world.links[host].cuts += 1
    world.later(fault.seconds, _mend, world, host)
    return True


def _mend(world: World, host: int) -> None:
    world.links[host].cuts -= 1
    world.later(0.02, world.look, host)


def _lose_token(world: World, fault: Fault) -> bool:
    """One side alone sees the other vanish: the coordinator, or with a larger `amount` the worker, for a moment."""
    worker = _worker(world, fault)
    if worker is None:
        return False
    if fault.amount < 0.6:
        world.send_to_coordinator(worker.identity, "gone")
    else:
        world.look(_host(world, fault), blink=True)
    return True


def _late_token(world: World, fault: Fault) -> bool:
    """A departure that is reported `amount` seconds late, perhaps after the worker is back."""
    worker = _worker(world, fault)
    if worker is None:
        return False
    world.later(fault.amount, world.send_to_coordinator, worker.identity, "gone")
    return True


def _kill_worker(world: World, fault: Fault) -> bool:
    """A process ends; its token vanishes `amount` later, before or after its last results have arrived."""
    if _worker(world, fault) is None:
        return False
    world.end_worker(_host(world, fault), fault.amount, fault.seconds)
    return True


def _stop_worker(world: World, fault: Fault) -> bool:
    """A process is suspended and goes on; if that takes longer than a lease, both sides notice."""
    worker, host = _worker(world, fault), _host(world, fault)
    if worker is None or worker.stopped:
        return False
    worker.stopped = True
    if fault.seconds > LEASE:
        world.later(LEASE, world.send_to_coordinator, worker.identity, "gone")
    world.later(fault.seconds, _go_on, world, host, worker, fault.seconds > LEASE)
    return True


def _go_on(world: World, host: int, worker: Worker, parted: bool) -> None:
    if world.workers[host] is not worker:
        return
    worker.stopped = False
    worker.awake_since = world.now
    world._wakes.pop(host, None)
    if parted:
        world.look(host, blink=True)
    world.wake_worker(host, worker, world.now)


def _slow_worker(world: World, fault: Fault) -> bool:
    """Turns that begin now take longer, up to ten times."""
    worker = _worker(world, fault)
    if worker is None:
        return False
    worker.slowness = 1.0 + fault.amount
    world.later(fault.seconds, _recover, worker)
    return True


def _recover(worker: Worker) -> None:
    worker.slowness = 1.0


def _drain_worker(world: World, fault: Fault) -> bool:
    """Somebody presses Ctrl-C once."""
    worker = _worker(world, fault)
    if worker is None:
        return False
    worker.membership.stop()
    return True


def _fail(world: World, fault: Fault) -> bool:
    """The next turns give an error instead of a fitness."""
    worker = _worker(world, fault)
    if worker is None:
        return False
    worker.failures += math.ceil(fault.amount)
    return True


def _kill_coordinator(world: World, fault: Fault) -> bool:
    """It ends after `amount` more steps of its turns: between any event, write, commit and message."""
    if world.coordinator is None:
        return False
    world.kill = Pending(int(fault.amount), fault.seconds, opening=fault.kind == "kill_at_opening")
    return True


def _stop_coordinator(world: World, fault: Fault) -> bool:
    """It stands still, as on a suspended host: what arrives waits, and the clock makes a jump."""
    life = world.coordinator
    if life is None or world.coordinator_stopped:
        return False
    world.coordinator_stopped = True
    world.later(fault.seconds, _continue_coordinator, world, life, fault.seconds > LEASE)
    return True


def _continue_coordinator(world: World, life: object, parted: bool) -> None:
    if world.coordinator is not life:
        return
    world.coordinator_stopped = False
    for host, worker in enumerate(world.workers):
        if parted and worker is not None:
            world.send_to_coordinator(worker.identity, "gone")
            world.look(host, blink=True)
    world._wakes.pop(-1, None)
    world.wake_coordinator(0.0)


def _leave(world: World, _fault: Fault) -> bool:
    """Somebody says `dreamfleet drain`: what runs is finished, then the coordinator leaves."""
    life = world.coordinator
    if life is None:
        return False
    life.draining = True
    life.run.pause(DRAINING)
    return True


def _pause(world: World, fault: Fault) -> bool:
    """Somebody says `dreamfleet pause`, and after a while `dreamfleet resume`."""
    life = world.coordinator
    if life is None:
        return False
    life.run.pause(BY_HAND)
    world.later(fault.seconds, world.resume, life)
    return True


def _bar(world: World, fault: Fault) -> bool:
    """Somebody bars an honest host, so what it brought is recalled, and lets it in again."""
    life, host = world.coordinator, _host(world, fault)
    if life is None or world.coordinator_stopped or world.is_silent or life.run.bar(f"w{host}"):
        return False
    world.wake_coordinator(0.0)
    world.later(fault.seconds, world.unbar, host)
    return True


def _resume(world: World, _fault: Fault) -> bool:
    """Somebody says `dreamfleet resume` of a run that is not paused: what failed is tried again."""
    life = world.coordinator
    if life is None or life.draining or life.run.state.paused is not None:
        return False
    life.run.resume()
    return True


def _stranger(world: World, fault: Fault) -> bool:
    """A result that nobody asked for: of no job, or another fitness of one that counts already."""
    known = list(world.disk.tables["result"])
    unknown = bytes([int(fault.at * 100) % 256]) * 32
    digest = known[int(fault.at * 1000) % len(known)] if known and fault.amount > 1.0 else unknown
    worker = _worker(world, fault)
    # Where results are checked, a forger can have a worker barred in whose name it speaks: it is a stranger there.
    in_its_name = worker is not None and not world.shape.verify
    identity = worker.identity if worker is not None and in_its_name else "stranger/0badc0de"
    result = Result(digest, 99.0, STEPS, 0.1, None, None)
    world.send_to_coordinator(identity, ResultBatch(run_uid=UID, incarnation=1, fingerprint="f", results=(result,)))
    return True


def _garble(world: World, fault: Fault) -> bool:
    """The next batch names another seed than the one that the digest is of."""
    world.links[_host(world, fault)].garbled = True
    return True


def _host(world: World, fault: Fault) -> int:
    return fault.worker % world.shape.workers


def _worker(world: World, fault: Fault) -> Worker | None:
    return world.workers[_host(world, fault)]


_STRIKES: dict[str, Callable[[World, Fault], bool]] = {
    "cut": _cut,
    "cut_unnoticed": _cut_unnoticed,
    "lose_token": _lose_token,
    "late_token": _late_token,
    "kill_worker": _kill_worker,
    "stop_worker": _stop_worker,
    "slow_worker": _slow_worker,
    "drain_worker": _drain_worker,
    "fail": _fail,
    "kill_coordinator": _kill_coordinator,
    "kill_at_opening": _kill_coordinator,
    "stop_coordinator": _stop_coordinator,
    "leave": _leave,
    "pause": _pause,
    "bar": _bar,
    "resume": _resume,
    "stranger": _stranger,
    "garble": _garble,
}
