"""Removes results of barred hosts from a journal, and everything computed from them. Pages: trust.md, protocol.md."""

import json
from collections.abc import Collection, Iterable, Sequence
from itertools import groupby
from time import time

from dreamfleet.common.protocol.keys import host_of
from dreamfleet.common.runs.journal.journal_reader import digest_terms
from dreamfleet.common.runs.run_folder import CONFIRMED, ENDED_AT, ENDING, STOP_KIND
from dreamfleet.common.runs.seeds import CHOOSING_OFFSET
from dreamfleet.coordinator.jobs.scoring_job import ScoringJob
from dreamfleet.coordinator.optimisers.checkpoint import Checkpoint
from dreamfleet.coordinator.storage.checksum_records import ChecksumRecords
from dreamfleet.coordinator.storage.journal_connection import JournalConnection
from dreamfleet.coordinator.storage.result_records import COLUMNS, ResultRecords

# Why a result does not count: its host is barred, its generation was dropped, or its closed race did not want it.
BARRED, REWOUND, SURPLUS = "barred", "rewound", "surplus"
WAS_CLOSED = "EXISTS (SELECT 1 FROM generation WHERE number = result.generation AND closed IS NOT NULL)"
CONFIRMS = f"kind = 'evaluate' AND episode >= {CHOOSING_OFFSET}"  # of a row that only chose and confirmed the report
KIND = f"CASE WHEN {CONFIRMS} THEN 'confirm' ELSE kind END"
HOST = "substr(worker, 1, instr(worker || '/', '/') - 1)"


class RecallRecords:
    """Takes results back, and rewinds to an earlier generation; nothing is durable before the caller's commit.

    What is taken back stays in the table `recalled`. Results of honest hosts in dropped generations count again once a
    generation wants the same jobs, unless their host is barred later: a job's digest names its content (R1).
    """

    def __init__(self, journal: JournalConnection, checksums: ChecksumRecords, results: ResultRecords) -> None:
        self._journal = journal
        self._checksums = checksums
        self._results = results
        self._has_set_aside: bool | None = None  # whether `recalled` may hold results that could count again

    def first_brought(self, hosts: Collection[str]) -> dict[str, int]:
        """The first generation to which these hosts brought a result or a lasting failure, by kind.

        Or in which they alone confirmed a result: of hosts that lie alike, each confirms what the other brings.
        `confirm` is the kind of episodes that are part of no evaluation: they chose and confirmed the report.
        """
        query = f"SELECT {KIND}, min(generation) FROM result WHERE {_of(hosts)} GROUP BY 1"  # noqa: S608
        first: dict[str, int] = dict(self._journal.read(query, *hosts))
        for _, kind, generation in (*self._failures_of(hosts), *self._confirmed_by(hosts)):
            first[kind] = min(generation, first.get(kind, generation))
        return first

    def recall(self, hosts: Collection[str]) -> int:
        """Take back all that these hosts brought, and reopen the evaluations that it was part of; returns how much."""
        write, mine = self._journal.write, _of(hosts)
        reopened = (
            "UPDATE evaluation SET mean = NULL, std = NULL, failed = 0, checksum = NULL WHERE vector IN "
            "(SELECT vector FROM evaluation WHERE generation IN "
        )
        failed = self._failures_of(hosts)
        write(f"{reopened} (SELECT generation FROM result WHERE {KIND} = 'evaluate' AND {mine}))", *hosts)  # noqa: S608
        others = (*failed, *self._confirmed_by(hosts))
        self._journal.write_all(f"{reopened} (?))", [(number,) for _, kind, number in others if kind == "evaluate"])
        self._journal.write_all("DELETE FROM failure WHERE digest = ?", [(digest,) for digest, *_ in failed])
        (count,) = self._journal.read_row(f"SELECT count(*) FROM result WHERE {mine}", *hosts)  # noqa: S608
        scored = f"SELECT DISTINCT generation FROM result WHERE kind = 'score' AND {mine}"  # noqa: S608
        # A closed batch keeps its fitness.
        self._checksums.closed += [number for (number,) in self._journal.read(scored, *hosts)]
        self._set_aside(BARRED, mine, *hosts)
        # Such as of generations that an earlier recall dropped.
        write(f"UPDATE recalled SET because = ? WHERE because != ? AND {mine}", BARRED, BARRED, *hosts)  # noqa: S608
        self._void_checks(hosts)
        self._settle_recall()
        return int(count)

    def rewind(self, number: int, state: Checkpoint | bytes, seeds: Sequence[int]) -> None:
        """Open generation `number` again as it was first asked for, and drop what came after it.

        `state` is the strategy's before that `ask`. Results of the generation itself stay, and those that its race
        did not want are here again: its barrier may be another.
        """
        write = self._journal.write
        self._count_again(number, "because = ? AND generation = ?", SURPLUS, number)
        write("UPDATE recalled SET because = ? WHERE because = ? AND generation > ?", REWOUND, SURPLUS, number)
        self._set_aside(REWOUND, "generation > ? OR (generation = ? AND kind != 'score')", number, number)
        write("DELETE FROM failure WHERE generation > ? OR (generation = ? AND kind != 'score')", number, number)
        for table in ("evaluation", "collection"):
            write(f"DELETE FROM {table} WHERE generation >= ?", number)  # noqa: S608
        first = "SELECT vector FROM redraw WHERE redraw.generation = ? AND redraw.candidate = candidate.number"
        write(
            f"UPDATE candidate SET vector = ({first} ORDER BY round LIMIT 1) WHERE generation = ? "  # noqa: S608
            f"AND EXISTS ({first})",
            number, number, number,
        )  # fmt: skip
        write("DELETE FROM redraw WHERE generation >= ?", number)
        write("DELETE FROM candidate WHERE generation > ?", number)
        write("UPDATE candidate SET fitness = NULL, measures = NULL WHERE generation = ?", number)
        write("DELETE FROM strategy")
        write("DELETE FROM generation WHERE number > ?", number)
        write(
            "UPDATE generation SET closed = NULL, mean = NULL, std = NULL, best = NULL, worst = NULL, steps = NULL, "
            "failed = 0, checksum = NULL, seeds = ? WHERE number = ?",
            json.dumps(list(seeds)),
            number,
        )
        self._checksums.write_state(number, state)
        self._journal.opened = number
        self._settle_recall()

    @property
    def has_set_aside(self) -> bool:
        """Whether there may be results of dropped generations that `count_again` could count again."""
        if self._has_set_aside is None:
            row = self._journal.read_row("SELECT 1 FROM recalled WHERE because = ? LIMIT 1", REWOUND)
            self._has_set_aside = row is not None
        return self._has_set_aside

    def count_again(self, work: Iterable[ScoringJob]) -> None:
        """Count results of dropped generations again that these jobs want, as results of the jobs' own generations.

        Of a mean that stays, another generation may want what a dropped one did.
        """
        if not self.has_set_aside:
            return
        for generation, jobs in groupby(work, key=lambda each: each.template.generation):
            for these, some in digest_terms([each.digest for each in jobs]):
                self._count_again(generation, f"because = ? AND {these}", REWOUND, *some)

    def set_surplus_aside(self, generation: int, digests: Sequence[bytes]) -> None:
        """Count these results and failures of a race no more, which is about to close and does not want them.

        So the results of a closed generation are those of its fitness and steps.
        """
        for these, some in digest_terms(digests):
            self._set_aside(SURPLUS, f"kind = 'score' AND generation = ? AND {these}", generation, *some)
            self._journal.write(f"DELETE FROM failure WHERE {these}", *some)  # noqa: S608
            self._journal.write(f"UPDATE verification SET stands = 0 WHERE {these}", *some)  # noqa: S608
        self._results.forget_totals()

    def rollouts(self) -> list[tuple[int, int]]:
        """Generation and episode of the rollouts that count no more, and that were not collected again."""
        query = (
            "SELECT DISTINCT generation, episode FROM recalled WHERE kind = 'collect' "
            "EXCEPT SELECT generation, episode FROM result WHERE kind = 'collect'"
        )
        return [(int(generation), int(episode)) for generation, episode in self._journal.read(query)]

    def _failures_of(self, hosts: Collection[str]) -> list[tuple[bytes, str, int]]:
        """Digest, kind and generation of the lasting failures to which any of these hosts contributed."""
        rows = self._journal.read(f"SELECT digest, {KIND}, generation, workers FROM failure")  # noqa: S608
        return [
            (digest, kind, generation)
            for digest, kind, generation, workers in rows
            if set(hosts) & {*map(host_of, workers.split(","))}
        ]

    def _confirmed_by(self, hosts: Collection[str]) -> list[tuple[bytes, str, int]]:
        """Digest, kind and generation of the results that were checked, and by nobody else than these hosts."""
        kind = f"CASE WHEN digest IN (SELECT digest FROM result WHERE {CONFIRMS}) THEN 'confirm' ELSE kind END"  # noqa: S608
        query = f"SELECT digest, {kind}, generation, checker FROM verification"  # noqa: S608
        rows = self._journal.read(f"{query} WHERE stands AND outcome != 'unchecked'")
        return [tuple(checked) for *checked, checkers in rows if set(checkers.split(",")) <= set(hosts)]

    def _set_aside(self, because: str, where: str, *values: object) -> None:
        """Move results into the table of those that do not count."""
        self._journal.write(
            f"INSERT INTO recalled ({COLUMNS}, because, happened, was_closed) SELECT {COLUMNS}, '{because}', ?, "  # noqa: S608
            f"{WAS_CLOSED} FROM result WHERE {where}",
            time(),
            *values,
        )
        self._journal.write(f"DELETE FROM result WHERE {where}", *values)  # noqa: S608

    def _count_again(self, generation: int, where: str, *values: object) -> None:
        """Move results back from those that do not count, to this generation, and let their checks stand again.

        A check stands by the word of a host that is still believed.
        """
        write = self._journal.write
        taken = self._journal.read(f"SELECT DISTINCT digest FROM recalled WHERE {where}", *values)  # noqa: S608
        if not taken:
            return
        write("UPDATE evaluation SET checksum = NULL WHERE generation = ?", generation)
        self._checksums.is_unsealed = True
        columns = COLUMNS.replace("generation", "?")
        back = f"INSERT OR IGNORE INTO result ({COLUMNS}) SELECT {columns} FROM recalled WHERE {where}"  # noqa: S608
        write(back, generation, *values)
        write(f"DELETE FROM recalled WHERE {where}", *values)  # noqa: S608
        self._journal.write_all(
            "UPDATE verification SET stands = 1, generation = ? WHERE digest = ? AND outcome = 'equal' "
            "AND checker != ''",
            [(generation, *each) for each in taken],
        )
        self._results.forget_totals()

    def _void_checks(self, hosts: Collection[str]) -> None:
        """Take these hosts from those that confirm results; a check that none is left of stands no more.

        `checker` lists hosts with commas between them.
        """
        lists = "instr(',' || checker || ',', ',' || ? || ',')"
        without = "trim(replace(',' || checker || ',', ',' || ? || ',', ','), ',')"
        for host in hosts:
            self._journal.write(f"UPDATE verification SET checker = {without} WHERE {lists}", host, host)  # noqa: S608
        self._journal.write("UPDATE verification SET stands = 0 WHERE checker = '' AND outcome != 'unchecked'")

    def _settle_recall(self) -> None:
        """Let checks of results that do not count any more stand no longer, and no end or confirmation follow."""
        self._journal.write("UPDATE verification SET stands = 0 WHERE digest NOT IN (SELECT digest FROM result)")
        for fact in (ENDING, STOP_KIND, "ended", ENDED_AT, CONFIRMED):
            self._journal.drop_fact(fact)
        self._checksums.is_unsealed = True
        self._results.forget_totals()
        self._has_set_aside = None


def _of(hosts: Collection[str]) -> str:
    """The condition that a row is of these hosts' workers."""
    return f"{HOST} IN ({', '.join('?' * len(hosts))})"
