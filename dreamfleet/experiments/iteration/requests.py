"""What each phase asks of the stages, by the settings and what is finished alone."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dreamfleet.common.cli.world_flags import OPTIONS, world_arguments
from dreamfleet.common.host.resource_limits import usable_cores
from dreamfleet.common.runs.seeds import VALIDATION
from dreamfleet.experiments.iteration.config import LATER_UPDATES, IterateConfig
from dreamfleet.experiments.iteration.layout import IterationFolder
from dreamfleet.experiments.iteration.ledger import IterationLedger
from dreamfleet.experiments.iteration.plan import EVOLVE, GATE, MDNRNN, VAE, Phase
from dreamfleet.experiments.local.command_lines import Words, options
from dreamfleet.experiments.pipeline import read_bundle, read_training
from dreamfleet.worker.addons.inspection.measure import FigureName, MeasureRequest
from dreamfleet.worker.addons.refit.stages import RefitRequest, SubspaceRequest
from dreamfleet.worker.training.stages.bundle import BundleRequest
from dreamfleet.worker.training.stages.collect import CollectRequest, ImportRequest
from dreamfleet.worker.training.stages.train import Model, TrainRequest

GATE_SEED = VALIDATION.start + 30_000  # the first track of a gate: no evaluation and no confirmation has it
GATE_NOISE = 0.3  # as in docs/lab/dreams-notes.md


@dataclass(frozen=True)
class Requests:
    """Each phase's requests, and the flags of its coordinator."""

    config: IterateConfig
    layout: IterationFolder
    ledger: IterationLedger

    def seed(self, phase: Phase) -> int:
        """The seed of a phase: each round's trainings and run have their own; a gate's is its first track."""
        ours = self.config.seed + phase.round
        return {VAE: ours - 1, MDNRNN: ours - 1, EVOLVE: ours, GATE: GATE_SEED}.get(phase.name, self.config.seed)

    def collect(self, number: int) -> CollectRequest:
        """Random drives: the first round's, or those that a later round adds."""
        more = self.ledger.episodes + self.config.more_drives
        return self._collect(self.config.drives if number == 1 else more)

    def import_kept(self, number: int) -> ImportRequest:
        """The rollouts that the last round's run kept."""
        return ImportRequest(self.layout.root, self.layout.run_name(number - 1), self.layout.runs)

    def drive(self, pilots: Sequence[Path]) -> CollectRequest:
        """Drives of the last round's means, from these controller files."""
        config = self.config
        spells = {"spells": config.spells} if config.spells else {}
        return self._collect(self.ledger.episodes + config.own_drives, pilots, noise=config.noise, **spells)

    def train(self, number: int, model: Model) -> TrainRequest:
        """The training of a model: from nothing, or on from the world model that counts."""
        config, flags = self.config, self.config.flags(f"{model}_flags")
        if not config.is_from_scratch(number):
            updates = getattr(config, f"{model}_updates")
            if updates is None:  # of a flag that is given twice the latter counts
                flags = (*options(updates=LATER_UPDATES[model]), *flags)
            else:
                flags = (*flags, *options(updates=updates))
            before = self.layout.checkpoint(self.ledger.model_round(number - 1), model)
            kept = ("--decoder-only",) if model == VAE and config.vae == "decoder" else ()
            flags = (*flags, *options(continue_from=before), *kept)
        seed, place = self.seed(Phase(number, model)), options(preset=config.training_preset, device=config.device)
        return read_training(model, self.layout.round(number), seed, *place, *flags)

    def bundle(self, number: int) -> BundleRequest:
        """A round's models as one file."""
        return read_bundle(self.layout.round(number), self.layout.bundle(number), *self.config.flags("bundle_flags"))

    def refit(self, number: int, path: Path) -> RefitRequest:
        """The last round's optimum fitted to this round's new world model."""
        layout = self.layout
        return RefitRequest(str(layout.optimum(number - 1)), str(layout.bundle(number)), layout.root, path)

    def subspace(self, number: int, path: Path) -> SubspaceRequest:
        """The subspace of what the model that counts foretells of the last drives."""
        bundle = str(self.layout.bundle(self.ledger.model_round(number)))
        return SubspaceRequest(bundle, self.layout.root, path, views=self.config.views)

    def gate(self, number: int) -> dict[str, dict[FigureName, MeasureRequest]]:
        """What is measured of the `old` and the `new` world model: `probe`, `losses`, `survival`.

        Both are probed on the same drives of the last round's optimum. For losses the optimum drives in the dream, so
        the new model gets it refitted.
        """
        config, layout = self.config, self.layout
        optimum = layout.optimum(number - 1)
        sides = {"old": (layout.bundle(self.ledger.model_round(number - 1)), optimum),
                 "new": (layout.bundle(number), layout.refitted(number))}  # fmt: skip
        found: dict[str, dict[FigureName, MeasureRequest]] = {side: {} for side in sides}
        for side, (bundle, driver) in sides.items():
            asked: tuple[tuple[FigureName, int, Path | None], ...] = (
                ("probe", config.gate_drives, optimum),
                ("losses", config.gate_losses, driver),
                ("survival", config.survival_episodes, None),
            )
            for figure, episodes, controller in asked:
                if episodes:
                    found[side][figure] = MeasureRequest(
                        (figure,), str(bundle), str(controller) if controller else None, episodes=episodes,
                        seed=GATE_SEED, noise=GATE_NOISE,
                    )  # fmt: skip
        return found

    def run_flags(self, number: int, start: Path | None = None, subspace: Path | None = None) -> Words:
        """The flags of a round's new run."""
        bundle, seed = self.layout.bundle(self.ledger.model_round(number)), self.seed(Phase(number, EVOLVE))
        own = options(bundle=bundle, seed=seed, init=start, subspace=subspace)
        return (*self.config.flags_of_run(number), *own)

    def _collect(self, episodes: int | None, pilots: Sequence[Path] = (), **settings: object) -> CollectRequest:
        config = self.config
        world = world_arguments(argparse.Namespace(**{name: getattr(config, name) or None for name in OPTIONS}))
        amounts = {"seed": config.seed, "episodes": episodes, "steps": config.drive_steps, **settings}
        given = {name: value for name, value in amounts.items() if value is not None}
        return CollectRequest(
            self.layout.root, config.training_preset, config.task or None, world, given,
            config.jobs or usable_cores(), tuple(map(str, pilots)),
        )  # fmt: skip
