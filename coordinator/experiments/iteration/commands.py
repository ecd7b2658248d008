"""The verbs that each phase calls, as words: a function of the settings, of what is finished, and of nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.runs.seeds import VALIDATION
from dreamfleet.coordinator.experiments.iteration.config import IterateConfig, split_flags
from dreamfleet.coordinator.experiments.iteration.layout import IterationFolder
from dreamfleet.coordinator.experiments.iteration.ledger import IterationLedger
from dreamfleet.coordinator.experiments.iteration.plan import EVOLVE, GATE, MDNRNN, VAE, Phase

Words = tuple[str, ...]
GATE_SEED = VALIDATION.start + 30_000  # the first track of a gate: no evaluation and no confirmation has it
GATE_NOISE = 0.3  # the measurements of docs/dreams.md
LATER_UPDATES = {VAE: 1800, MDNRNN: 600}  # of a round that goes on with a model, if nobody says otherwise


@dataclass(frozen=True)
class Commands:
    """Each phase's verbs."""

    config: IterateConfig
    layout: IterationFolder
    ledger: IterationLedger

    def seed(self, phase: Phase) -> int:
        """What a phase draws its chance from, each round's training and run their own; a gate's is its first track."""
        ours = self.config.seed + phase.round
        return {VAE: ours - 1, MDNRNN: ours - 1, EVOLVE: ours, GATE: GATE_SEED}.get(phase.name, self.config.seed)

    def unbundle(self) -> Words:
        """The models of the world model that the iteration goes on from."""
        return _words("unbundle", self.layout.bundle(0), "--data", self.layout.round(0), "--json")

    def collect(self, number: int) -> Words:
        """Random drives: those of the first round, or so many more."""
        more = self.ledger.episodes + self.config.more_drives
        return self._collect(self.config.drives if number == 1 else more)

    def import_kept(self, number: int) -> Words:
        """The rollouts that the last round's run kept."""
        layout = self.layout
        name = layout.run_name(number - 1)
        return _words("collect", "--data", layout.root, "--from-run", name, "--runs-dir", layout.runs, "--json")

    def drive(self, pilots: Sequence[Path]) -> Words:
        """Drives of the last round's means, which lie in these files."""
        config = self.config
        wanted = self.ledger.episodes + config.own_drives
        spells = ("--spells", config.spells) if config.spells else ()
        return self._collect(wanted, "--noise", config.noise, *spells, "--controller", *pilots)

    def train(self, number: int, model: str) -> Words:
        """The training of `vae` or `mdnrnn`: from nothing, or on from the world model that counts."""
        config, seed = self.config, self.seed(Phase(number, model))
        common = _words(
            "train", model, "--data", self.layout.round(number), "--preset", config.preset, "--device", config.device,
            "--seed", seed, "--json",
        )  # fmt: skip
        flags = split_flags(f"{model}_flags", getattr(config, f"{model}_flags"))
        if config.is_from_scratch(number):
            return (*common, *flags)
        before = self.layout.checkpoint(self.ledger.model_round(number - 1), model)
        said = getattr(config, f"{model}_updates")  # of a flag that is said twice the latter counts
        updates = ("--updates", LATER_UPDATES[model], *flags) if said is None else (*flags, "--updates", said)
        kept = ("--decoder-only",) if model == "vae" and config.vae == "decoder" else ()
        return (*common, *_words(*updates, "--continue-from", before, *kept))

    def check_training(self, model: str) -> Words:
        """The same without training anything: whether its flags are of the verb, and of the model to go on with."""
        return (*self.train(1, model), "--summary")

    def check_trainings(self) -> tuple[Words, ...]:
        """Check the training flags of both models of the world model that the iteration starts from."""
        return tuple(self.check_training(model) for model in (VAE, MDNRNN))

    def encode(self, number: int) -> Words:
        """Latents of all drives."""
        return _words("encode", "--data", self.layout.round(number), "--json")

    def bundle(self, number: int) -> Words:
        """A round's models as one file."""
        return _words("bundle", "--data", self.layout.round(number), "--out", self.layout.bundle(number), "--json")

    def refit(self, number: int, path: Path) -> Words:
        """The last round's optimum fitted to this round's new world model."""
        layout = self.layout
        optimum, bundle = layout.optimum(number - 1), layout.bundle(number)
        return _words("refit", optimum, "--to", bundle, "--data", layout.root, "--out", path, "--json")

    def subspace(self, number: int, path: Path) -> Words:
        """What the model that counts foretells of the last drives."""
        bundle = self.layout.bundle(self.ledger.model_round(number))
        views = ("--views", self.config.views) if self.config.views else ()
        return _words("subspace", bundle, "--data", self.layout.root, *views, "--out", path, "--json")

    def gate(self, number: int) -> dict[str, dict[str, Words]]:
        """What is measured of the `old` and the `new` world model: `probe`, `losses`, or both.

        Both are watched on the same drives of the last round's optimum. In dreams of losses it has to drive by the
        model that dreams, so there the new one has it fitted to itself.
        """
        config, layout = self.config, self.layout
        optimum = layout.optimum(number - 1)
        sides = {"old": (layout.bundle(self.ledger.model_round(number - 1)), optimum),
                 "new": (layout.bundle(number), layout.refitted(number))}  # fmt: skip
        found: dict[str, dict[str, Words]] = {side: {} for side in sides}
        for side, (bundle, driver) in sides.items():
            if config.gate_drives:
                found[side]["probe"] = _inspect_words(bundle, "--probe", optimum, config.gate_drives)
            if config.gate_losses:
                found[side]["losses"] = _inspect_words(bundle, "--losses", driver, config.gate_losses)
        return found

    def begin_run(
        self, number: int, listen: Sequence[str], more: Sequence[str], start: Path | None = None,
        subspace: Path | None = None,
    ) -> Words:  # fmt: skip
        """A round's evolution; `more` are flags that stand before those of the run."""
        layout = self.layout
        places = {"--init": start, "--subspace": subspace}
        begun = [word for flag, path in places.items() if path is not None for word in (flag, path)]
        return (
            *_words("coordinator", *more, *self.config.flags_of_run(number)),
            *_words("--run", layout.run_name(number), "--bundle", layout.bundle(self.ledger.model_round(number)),
                    "--seed", self.seed(Phase(number, EVOLVE)), *begun, *self._network_flags(listen)),
        )  # fmt: skip

    def resume_run(self, number: int, listen: Sequence[str], security: Sequence[str] = ()) -> Words:
        """The same evolution, continued."""
        return _words("coordinator", "--resume", self.layout.run_name(number), *security, *self._network_flags(listen))

    def _network_flags(self, listen: Sequence[str]) -> Words:
        return _words("--runs-dir", self.layout.runs, "--json", "--listen", *listen)

    def _collect(self, episodes: int | None, *more: object) -> Words:
        config = self.config
        chosen = {"--episodes": episodes, "--steps": config.drive_steps, "--jobs": config.jobs}
        said = [word for flag, value in chosen.items() if value is not None for word in (flag, value)]
        return _words(
            "collect", "--data", self.layout.root, "--preset", config.preset, "--seed", config.seed, *said, *more,
            "--json",
        )  # fmt: skip


def _inspect_words(bundle: Path, figure: str, controller: Path, episodes: int) -> Words:
    return _words(
        "inspect", bundle, figure, "--controller", controller, "--episodes", episodes, "--seed", GATE_SEED,
        "--noise", GATE_NOISE, "--json",
    )  # fmt: skip


def _words(*told: object) -> Words:
    return tuple(map(str, told))
