"""The stages that make a world model, as functions: a typed request in, a typed report out. Verbs parse and print.

Pages: train.md, rounds.md.
"""

from dataclasses import asdict, dataclass
from typing import Any

__all__ = ["StageReport", "collect", "train", "encode", "bundle"]


@dataclass(frozen=True)
class StageReport:
    """What a stage made; as text for people."""

    @property
    def facts(self) -> dict[str, Any]:
        """The same as values by name, as its verb prints them under `--json`."""
        return asdict(self)
