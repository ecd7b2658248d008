"""Rewinding a run: what barred hosts brought is taken back, and the run goes on from the first generation with any.

A check finds a host wrong (R32), or the operator names it. Pages: decisions.md.
"""

from collections.abc import Collection
from contextlib import closing
from pathlib import Path

from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural, printable
from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.run_lock import run_lock
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.common.runs.seeds import training_seeds
from dreamfleet.common.runs.stages import StageTracker
from dreamfleet.coordinator.jobs.history import History
from dreamfleet.coordinator.jobs.rollout_collection import RolloutCollections
from dreamfleet.coordinator.run.failure_policy import forget_acceptance
from dreamfleet.coordinator.run.generations import Generations
from dreamfleet.coordinator.run.report import withdraw_controller
from dreamfleet.coordinator.storage.journal import Journal
from dreamfleet.coordinator.storage.verification_records import StoredBar

BAR_BY_OPERATOR = StoredBar("the operator says so", by_operator=True)


def recall(journal: Journal, settings: RunSettings, hosts: Collection[str]) -> str:
    """Take back what these hosts brought; what was done, in words. Nothing is durable before the journal's commit.

    R33: the first generation with a result of theirs opens again with the other hosts' results, and later ones are
    dropped, because their candidates follow from a wrong state of the strategy. The strategy's state is computed again
    from the fitness that the journal holds of the generations before.
    """
    of_hosts = f"of {', '.join(sorted(hosts))} recalled"
    if settings.is_external:
        results = plural(journal.recalls.recall(hosts), "result")
        return f"{results} {of_hosts}; what was handed out of complete batches stays"
    closed, evaluations = journal.read_closed()
    first = _first_affected(journal.recalls.first_brought(hosts), settings)
    words = f"{plural(journal.recalls.recall(hosts), 'result')} {of_hosts}"
    last = journal.last_generation()
    if last is None or first is None or first > last.number:
        return words
    finished = {each.generation: each for each in evaluations}
    replayed = Generations(journal, settings, StageTracker(settings), History(closed), finished)
    stored = journal.generation(first)  # only of the last two
    state = replayed.replay(first) if stored is None else stored.state
    seeds = training_seeds(settings.seed, first, len(journal.seeds_of(first)))  # as it was first asked for
    journal.recalls.rewind(first, state, seeds)
    forget_acceptance(journal, first)
    return f"{words}: the run goes on from generation {first}" + (f" (of {last.number})" if last.number > first else "")


def _first_affected(brought: dict[str, int], settings: RunSettings) -> int | None:
    """The first generation that would be another; `None` if no candidate depends on what was brought.

    An evaluation decides about candidates only where a stage ends at a score, and from the next generation on.
    """
    found = [brought["score"]] if "score" in brought else []
    is_decided = any(each.score is not None for each in settings.stages)
    if "evaluate" in brought and is_decided:
        found.append(brought["evaluate"] + 1)
    return min(found, default=None)


def find_bar_problem(host: str, barred: Collection[str], known: Collection[str], *, is_barred: bool) -> str:
    """Why the operator cannot bar a host, or with `is_barred` false let it in again; empty if nothing is in the way.

    `known` are the hosts that scored or are here: a misspelt name is none of them.
    """
    if (host in barred) == is_barred:
        return f"host {printable(host)} is {'barred already' if is_barred else 'not barred'}"
    if is_barred and host not in known:
        there = ", ".join(sorted(known)) or "none"
        return f"no worker of host {printable(host)} scored in this run or is here: there are {there}"
    return ""


def bar_stored(folder: Path, host: str, *, is_barred: bool) -> str:
    """Bar a host from the run in `folder`, which nobody serves, or let it in again; what was done, in words.

    R33: what it brought is taken back, so an ended run is open again. `UsageError` if the run is served, or if there is
    nothing to do; `DamagedJournalError` if the journal is not what was written. Then nothing is changed.
    """
    with run_lock(folder), closing(Journal.open_verified(folder)) as journal:
        known = {*map(host_of, journal.results.workers(recalled=True))}
        if problem := find_bar_problem(host, journal.verification.barred(), known, is_barred=is_barred):
            raise UsageError(problem)
        incarnation = journal.begin_incarnation()
        if is_barred:
            journal.verification.bar(host, BAR_BY_OPERATOR, incarnation)
            words = recall(journal, RunSettings.from_json(journal.fact("settings") or ""), {host})
            text = f"host {printable(host)} is barred from this run: {BAR_BY_OPERATOR.why}; {words}"
        else:
            journal.verification.unbar(host)
            text = unbar_words(host)
        journal.add_event(text, "barred" if is_barred else "unbarred", host)
        journal.end_incarnation()
        if is_barred:
            withdraw_controller(folder / CONTROLLER)  # now that nothing but the disk can refuse the recall
        journal.commit()
        RolloutCollections(folder).remove(journal.recalls.rollouts())  # not before the recall was durable
    return text


def unbar_words(host: str) -> str:
    """That the operator lets a host in again."""
    return f"host {printable(host)} may join this run again: the operator says so"
