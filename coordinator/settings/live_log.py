"""Where a run's curves are written while it goes on: the setting `log_to`."""

from collections.abc import Sequence
from typing import NamedTuple

from dreamfleet.common.errors import UsageError

TENSORBOARD = "tensorboard"


class SinkName(NamedTuple):
    """`tensorboard` or the MODULE:CLASS of a sink of the user's own, and where it writes; empty: its default place."""

    kind: str
    where: str

    @property
    def module(self) -> str:
        """The module that has the sink; empty for TensorBoard's."""
        return self.kind.partition(":")[0] if ":" in self.kind else ""


def parse_sink(text: str) -> SinkName:
    """`tensorboard` or MODULE:CLASS, perhaps with :WHERE behind it; `UsageError` for anything else.

    >>> parse_sink("tensorboard:/tmp/curves")
    SinkName(kind='tensorboard', where='/tmp/curves')
    >>> parse_sink("mine.sinks:Server:http://127.0.0.1:5000")
    SinkName(kind='mine.sinks:Server', where='http://127.0.0.1:5000')
    """
    module, _, rest = text.partition(":")
    if module == TENSORBOARD:
        return SinkName(module, rest)
    name, _, where = rest.partition(":")
    if not all(map(str.isidentifier, (*module.split("."), name))):
        raise UsageError(
            f"log_to {text!r}: give tensorboard, or a sink of your own as MODULE:CLASS; :WHERE may stand behind it "
            "(docs/how-to/monitor.md has sinks for Weights & Biases and MLflow)"
        )
    return SinkName(f"{module}:{name}", where)


def parse_sinks(texts: Sequence[str]) -> tuple[SinkName, ...]:
    """All of them; `UsageError` also if a kind is named twice."""
    found = tuple(map(parse_sink, texts))
    if len({each.kind for each in found}) < len(found):
        raise UsageError(f"log_to names a kind twice: {', '.join(texts)}")
    return found
