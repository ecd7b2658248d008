"""The paths in an iteration's folder."""

from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.runs.run_paths import BUNDLE, CONTROLLER

EPISODES, ENCODED = "episodes", "encoded"  # ENCODED counts alike: worker/training/encode.py


@dataclass(frozen=True)
class IterationFolder:
    """The folder: one data set of all drives, a folder a round with its models, and the rounds' runs.

    A round's folder is a data folder of its own for the verbs that train: it links to the drives.
    """

    root: Path

    @property
    def ledger(self) -> Path:
        """The ledger of finished phases."""
        return self.root / "iteration.json"

    @property
    def lock(self) -> Path:
        """The lock of the process that works here."""
        return self.root / "iteration.lock"

    @property
    def runs(self) -> Path:
        """The rounds' runs."""
        return self.root / "runs"

    def round(self, number: int) -> Path:
        """A round's models."""
        return self.root / "rounds" / f"{number:02d}"

    def log(self, number: int, name: str) -> Path:
        """The log of a verb of a round."""
        return self.round(number) / "logs" / f"{name}.log"

    def bundle(self, number: int) -> Path:
        """A round's frozen world model; of round 0 beside its controller, where controllers look for theirs."""
        return self.round(number) / (f"round-{number}.zip" if number else BUNDLE)

    def checkpoint(self, number: int, model: str) -> Path:
        """The weights that a round's training of `vae` or `mdnrnn` ended with."""
        return self.round(number) / f"{model}.safetensors"

    def run_name(self, number: int) -> str:
        """The name of a round's run."""
        return f"round-{number:02d}"

    def run(self, number: int) -> Path:
        """The folder of a round's run."""
        return self.runs / self.run_name(number)

    def optimum(self, number: int) -> Path:
        """The controller that a round ended with; of round 0 that of `--init`."""
        return (self.run(number) if number else self.round(number)) / CONTROLLER

    def means(self, number: int) -> Path:
        """The means of a round's run that drive for the next one, beside their world model."""
        return self.round(number) / "means"

    def gate_file(self, number: int) -> Path:
        """The figures of a round's gate, as they were measured."""
        return self.round(number) / "gate.json"

    def refitted(self, number: int) -> Path:
        """The last round's optimum, fitted to this round's new world model."""
        return self.round(number) / "moved.npz"

    def start(self, number: int) -> Path:
        """Where a round's evolution begins, if not at zero."""
        return self.round(number) / "start.npz"

    def subspace(self, number: int) -> Path:
        """The subspace of a round's evolution, if it has one."""
        return self.round(number) / "subspace.npz"

    def relative(self, path: Path) -> str:
        """A path below the folder, as the ledger writes it."""
        return path.relative_to(self.root).as_posix()
