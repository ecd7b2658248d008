"""The verbs that each phase runs, as command lines, by the settings and what is finished alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.cli import model_commands
from dreamfleet.common.cli.model_commands import MODELS, Model, Words, command, options
from dreamfleet.common.runs.seeds import VALIDATION
from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.layout import IterationFolder
from dreamfleet.experiments.iteration.ledger import IterationLedger
from dreamfleet.experiments.iteration.plan import EVOLVE, GATE, MDNRNN, VAE, Phase

GATE_SEED = VALIDATION.start + 30_000  # the first track of a gate: no evaluation and no confirmation has it
GATE_NOISE = 0.3  # as in docs/lab/dreams-notes.md
LATER_UPDATES = {VAE: 1800, MDNRNN: 600}  # default of a round that continues a model's training


@dataclass(frozen=True)
class Commands:
    """Each phase's verbs."""

    config: IterateConfig
    layout: IterationFolder
    ledger: IterationLedger

    def seed(self, phase: Phase) -> int:
        """The seed of a phase: each round's trainings and run have their own; a gate's is its first track."""
        ours = self.config.seed + phase.round
        return {VAE: ours - 1, MDNRNN: ours - 1, EVOLVE: ours, GATE: GATE_SEED}.get(phase.name, self.config.seed)

    def unbundle(self) -> Words:
        """Write the models of the initial world model as checkpoints."""
        return command("bundle", "--extract", self.layout.bundle(0), "--data", self.layout.round(0), "--json")

    def collect(self, number: int) -> Words:
        """Random drives: the first round's, or those that a later round adds."""
        more = self.ledger.episodes + self.config.more_drives
        return self._collect(self.config.drives if number == 1 else more)

    def import_kept(self, number: int) -> Words:
        """The rollouts that the last round's run kept."""
        layout = self.layout
        name = layout.run_name(number - 1)
        return command("collect", "--data", layout.root, "--from-run", name, "--runs-dir", layout.runs, "--json")

    def drive(self, pilots: Sequence[Path]) -> Words:
        """Drives of the last round's means, from these controller files."""
        config = self.config
        wanted = self.ledger.episodes + config.own_drives
        spells = ("--spells", config.spells) if config.spells else ()
        return self._collect(wanted, "--noise", config.noise, *spells, "--controller", *pilots)

    def train(self, number: int, model: Model) -> Words:
        """The training of a model: from nothing, or on from the world model that counts."""
        config, flags = self.config, self.config.flags(f"{model}_flags")
        if not config.is_from_scratch(number):
            updates = getattr(config, f"{model}_updates")
            if updates is None:  # of a flag that is given twice the latter counts
                flags = (*options(updates=LATER_UPDATES[model]), *flags)
            else:
                flags = (*flags, *options(updates=updates))
            before = self.layout.checkpoint(self.ledger.model_round(number - 1), model)
            kept = ("--decoder-only",) if model == "vae" and config.vae == "decoder" else ()
            flags = (*flags, *options(continue_from=before), *kept)
        return model_commands.train(
            model, self.layout.round(number), *flags, preset=config.training_preset, device=config.device,
            seed=self.seed(Phase(number, model)),
        )  # fmt: skip

    def check_training(self, model: Model) -> Words:
        """The first round's training with `--summary`: it checks flags and layers, and trains nothing."""
        return (*self.train(1, model), "--summary")

    def check_trainings(self) -> tuple[Words, ...]:
        """The checks of both models."""
        return tuple(self.check_training(model) for model in MODELS)

    def encode(self, number: int) -> Words:
        """Latents of all drives."""
        return model_commands.encode(self.layout.round(number))

    def bundle(self, number: int) -> Words:
        """A round's models as one file."""
        flags = self.config.flags("bundle_flags")
        return model_commands.bundle(self.layout.round(number), self.layout.bundle(number), *flags)

    def refit(self, number: int, path: Path) -> Words:
        """The last round's optimum fitted to this round's new world model."""
        layout = self.layout
        optimum, bundle = layout.optimum(number - 1), layout.bundle(number)
        return command("lab", "refit", optimum, "--to", bundle, "--data", layout.root, "--out", path, "--json")

    def subspace(self, number: int, path: Path) -> Words:
        """The subspace of what the model that counts foretells of the last drives."""
        bundle = self.layout.bundle(self.ledger.model_round(number))
        views = ("--views", self.config.views) if self.config.views else ()
        return command("lab", "subspace", bundle, "--data", self.layout.root, *views, "--out", path, "--json")

    def gate(self, number: int) -> dict[str, dict[str, Words]]:
        """What is measured of the `old` and the `new` world model: `probe`, `losses`, `survival`.

        Both are probed on the same drives of the last round's optimum. For losses the optimum drives in the dream, so
        the new model gets it refitted.
        """
        config, layout = self.config, self.layout
        optimum = layout.optimum(number - 1)
        sides = {"old": (layout.bundle(self.ledger.model_round(number - 1)), optimum),
                 "new": (layout.bundle(number), layout.refitted(number))}  # fmt: skip
        found: dict[str, dict[str, Words]] = {side: {} for side in sides}
        for side, (bundle, driver) in sides.items():
            if config.gate_drives:
                found[side]["probe"] = _inspect_words(bundle, "--probe", config.gate_drives, optimum)
            if config.gate_losses:
                found[side]["losses"] = _inspect_words(bundle, "--losses", config.gate_losses, driver)
            if config.survival_episodes:
                found[side]["survival"] = _inspect_words(bundle, "--survival", config.survival_episodes)
        return found

    def begin_run(
        self, number: int, listen: Sequence[str], more: Sequence[str], start: Path | None = None,
        subspace: Path | None = None,
    ) -> Words:  # fmt: skip
        """A round's evolution; `more` are flags that stand before those of the run."""
        layout = self.layout
        return model_commands.begin_run(
            layout.run_name(number), layout.runs, listen, *more, *self.config.flags_of_run(number),
            world_model=layout.bundle(self.ledger.model_round(number)), seed=self.seed(Phase(number, EVOLVE)),
            init=start, subspace=subspace,
        )  # fmt: skip

    def resume_run(self, number: int, listen: Sequence[str], security: Sequence[str] = ()) -> Words:
        """The same evolution, resumed."""
        return model_commands.resume_run(self.layout.run_name(number), self.layout.runs, listen, *security)

    def _collect(self, episodes: int | None, *more: object) -> Words:
        config = self.config
        return model_commands.collect(
            self.layout.root, *config.world_flags, *more, preset=config.training_preset, seed=config.seed,
            episodes=episodes, steps=config.drive_steps, jobs=config.jobs,
        )  # fmt: skip


def _inspect_words(bundle: Path, figure: str, episodes: int, controller: Path | None = None) -> Words:
    """The measurement of a world model; without a controller that of fixed policies alone."""
    noise = None if controller is None else GATE_NOISE
    more = options(controller=controller, episodes=episodes, seed=GATE_SEED, noise=noise)
    return command("inspect", bundle, figure, *more, "--json")
