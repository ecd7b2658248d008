"""Jobs that several hosts score, and what their answers prove. Pure.

R32: a share of the accepted results is scored again on another host of the same class, and compared to the bit. Where
two differ, further answers decide who is wrong; one difference alone accuses nobody. Each *voter* has one voice: a
host, or in a secured fleet all that share a join file, as one person may name many. Pages: trust.md, measurements.md.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

from dreamfleet.common.protocol.host_classes import NON_DETERMINISTIC
from dreamfleet.common.protocol.messages import Result


@dataclass
class Check:
    """Which hosts may be given a job again whose result is accepted."""

    host_class: str  # of the accepted result
    answered: set[str] = field(default_factory=set)  # voters
    passed_over: set[str] = field(default_factory=set)  # voters that failed, or took too long
    only: frozenset[str] | None = None  # voters that are asked once more; `None`: any other

    def may_ask(self, voter: str, host_class: str) -> bool:
        """Whether a host of this voter and class may be given the job."""
        if host_class != self.host_class or host_class in ("", NON_DETERMINISTIC) or voter in self.passed_over:
            return False
        return voter not in self.answered if self.only is None else voter in self.only


@dataclass(frozen=True)
class Answer:
    """What a host gave for a job: fitness, steps and measures, which are compared, and its seconds, which are not."""

    host: str
    voter: str
    fitness: float
    steps: int
    measures: tuple[float, ...] = ()
    seconds: float = 0.0

    @classmethod
    def of(cls, host: str, voter: str, result: Result) -> Answer:
        """From a result with a fitness."""
        assert result.fitness is not None
        return cls(host, voter, result.fitness, result.steps, tuple(result.measures), result.seconds)

    @property
    def value(self) -> tuple[float, int, tuple[float, ...]]:
        """What another host must give to the bit."""
        return self.fitness, self.steps, self.measures


@dataclass(frozen=True)
class Decision:
    """What follows from the answers: who is wrong, whom to ask next, or who waits for a third host.

    All are empty if the answers agree, or if no host can repeat its own.
    """

    wrong: frozenset[str] = frozenset()  # voters
    ask_other: bool = False
    ask_again: frozenset[str] = frozenset()  # these voters
    held: frozenset[str] = frozenset()
    by_trusted: bool = False  # whether the word of a trusted host alone says who is wrong


def decide(answers: Sequence[Answer], present: Collection[str], others: bool, trusted: Collection[str]) -> Decision:
    """What the answers of hosts of one class to one job prove.

    `present` are the voters that could answer again, `others` says whether one is here that has not answered, and
    `trusted` are those whose word decides against a single other one.

    R32: a value is right if two voters gave it and fewer gave any other; who ever gave another one is wrong. Without
    such a value another host answers. Without another host, each answers once more: who contradicts itself is wrong,
    if another does not. Of two that stay with their words, a trusted host is believed. Else both wait for a third host.
    """
    values = defaultdict(set)
    for each in answers:
        values[each.value].add(each.voter)
    voters = {each.voter for each in answers}
    if len(values) < 2:
        return Decision()
    first, second = sorted(values.items(), key=lambda each: -len(each[1]))[:2]
    if len(first[1]) >= 2 and len(first[1]) > len(second[1]):
        return Decision(frozenset(each.voter for each in answers if each.value != first[0]))
    if others:
        return Decision(ask_other=True)
    if once := {one for one in voters if sum(each.voter == one for each in answers) < 2} & set(present):
        return Decision(ask_again=frozenset(once))
    return _decide_between({one: {each.value for each in answers if each.voter == one} for one in voters}, trusted)


def _decide_between(values: dict[str, set[tuple[float, int, tuple[float, ...]]]], trusted: Collection[str]) -> Decision:
    """The decision where nobody else can be asked, from each voter's own values."""
    steady = frozenset(one for one, own in values.items() if len(own) == 1)
    unsteady = frozenset(values) - steady
    if len(steady) < 2:
        return Decision(unsteady) if steady else Decision()
    believed = steady & frozenset(trusted)
    if len(values) == 2 and len(believed) == 1:
        return Decision(steady - believed, by_trusted=True)
    return Decision(held=frozenset(values))
