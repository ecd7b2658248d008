"""Checksums over the rows of a journal: what SQLite finds sound may still be another page's, or have a wrong digit.

A checksum is written once nothing of what it covers changes any more. What is open has none, and is not compared.
"""

import hashlib
from collections.abc import Callable, Iterable
from typing import Any

from dreamfleet.common.runs.seeds import CHOOSING_OFFSET

Read = Callable[..., list[Any]]
"""Takes a query and its values, and gives all rows."""
SIZE = 16  # bytes of a checksum; a generation's and an evaluation's are two, of the row and of its parts
RECORD, REST = "checksum", "rest_checksum"  # names of facts: of all other facts, and of what belongs to no generation
SEALED = "sealed"  # the fact with the numbers of generations and evaluations that have a checksum
COUNT_SEALED = (
    "SELECT (SELECT count(*) FROM generation WHERE checksum IS NOT NULL), "
    "(SELECT count(*) FROM evaluation WHERE checksum IS NOT NULL)"
)
GENERATION_ROW = (
    "SELECT number, seeds, opened, closed, mean, std, best, worst, sigma, steps, seconds, failed, checksum "
    "FROM generation WHERE closed IS NOT NULL"
)
EVALUATION_ROW = "SELECT generation, vector, episodes, mean, std, failed, checksum FROM evaluation"
_RESULT = (
    "SELECT digest, generation, candidate, episode, seed, fitness, steps, seconds, worker, fingerprint, incarnation, "
    "host_class, measures FROM result WHERE kind = "
)
_GENERATION_PARTS = (
    "SELECT number, vector, fitness, measures FROM candidate WHERE generation = ? ORDER BY number",
    "SELECT round, candidate, vector FROM redraw WHERE generation = ? ORDER BY round, candidate",
    f"{_RESULT} 'score' AND generation = ? ORDER BY candidate, episode, digest",
    "SELECT number, id, content, seeds, population, state, errors FROM batch WHERE generation = ?",
)
_EVALUATION_PARTS = (
    f"{_RESULT} 'evaluate' AND generation = ? AND episode < {CHOOSING_OFFSET} ORDER BY candidate, episode, digest",
)
_REST = (
    f"{_RESULT} 'evaluate' AND episode >= {CHOOSING_OFFSET} ORDER BY generation, candidate, episode, digest",
    f"{_RESULT} 'collect' ORDER BY generation, candidate, episode, digest",
    "SELECT generation, vector, episodes FROM collection ORDER BY generation",
    "SELECT count(*), max(number) FROM generation",
    "SELECT outcome, count(*) FROM verification GROUP BY 1 ORDER BY 1",
    "SELECT host, why, by_trusted, by_operator FROM barred ORDER BY host",
    "SELECT because, count(*) FROM recalled GROUP BY 1 ORDER BY 1",
    "SELECT digest, kind, generation, candidate, episode, seed, error, cause, fault FROM failure ORDER BY digest",
)


def checksum_of(*parts: object) -> bytes:
    """The checksum of plain values: numbers, text, bytes, `None`, and rows of them."""
    found = hashlib.blake2b(digest_size=SIZE)
    for each in parts:
        found.update(each if isinstance(each, bytes) else repr(each).encode("utf-8", "surrogatepass"))
    return found.digest()


def generation_parts(read: Read, number: int) -> bytes:
    """The checksum of a generation's candidates, redraws and results."""
    return checksum_of(*(read(query, number) for query in _GENERATION_PARTS))


def evaluation_parts(read: Read, generation: int) -> bytes:
    """The checksum of an evaluation's results, without those that choose and confirm the reported mean."""
    return checksum_of(*(read(query, generation) for query in _EVALUATION_PARTS))


def rest_checksum(read: Read) -> str:
    """The checksum of what belongs to no generation or evaluation of an ended run."""
    return checksum_of(*map(read, _REST)).hex()


def record_checksum(facts: Iterable[tuple[str, str]]) -> str:
    """The checksum of the run's facts."""
    return checksum_of(sorted(each for each in facts if each[0] != RECORD)).hex()


def state_checksum(generation: int, state: bytes) -> bytes:
    """The checksum of a strategy's packed state before a generation."""
    return checksum_of(generation, state)


def sealed_text(read: Read) -> str:
    """How many generations and evaluations have a checksum: a row that is lost takes its own checksum with it."""
    ((generations, evaluations),) = read(COUNT_SEALED)
    return f"{generations} {evaluations}"


def row_checksum(row: tuple[Any, ...], parts: bytes) -> bytes:
    """What is stored with a row of `GENERATION_ROW` or `EVALUATION_ROW`."""
    return checksum_of(row[:-1], parts) + parts


def is_row_sound(row: tuple[Any, ...]) -> bool:
    """Whether a row agrees with its checksum, if it has one."""
    return row[-1] is None or (isinstance(row[-1], bytes) and row_checksum(row, row[-1][SIZE:]) == row[-1])
