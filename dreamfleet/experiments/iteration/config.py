"""What an iteration is; what of it may change while it is under way."""

from dataclasses import dataclass
from typing import Literal

from dreamfleet.common.artifacts.driving import FIRST_WORLD
from dreamfleet.common.cli.config import option
from dreamfleet.common.cli.key_values import split_flags
from dreamfleet.common.cli.presets import NAMES, check_preset, default_training_preset
from dreamfleet.common.errors import UsageError
from dreamfleet.experiments.local.command_lines import Words

# They change no round that is finished, nor what it means; what `--run-flags` lead to is compared instead of them.
CHANGEABLE = frozenset({"rounds", "local", "jobs", "device", "run_flags"})
MOST_SEED = 2**31 - 1  # each round's training multiplies its own
RUN_FLAGS = ("run_flags", "later_run_flags")
# Flags of trainings and `bundle` that iterate sets itself.
RESERVED_FLAGS = (
    "--data", "--preset", "--device", "--seed", "--continue-from", "--new", "--summary", "--json", "--out", "--extract",
    "--from",
)  # fmt: skip
SURVIVAL_EPISODES = 40
LATER_UPDATES = {"vae": 1800, "mdnrnn": 600}  # default of a round that continues a model's training
LEAST = {
    "rounds": 1, "drives": 2, "more_drives": 0, "own_drives": 0, "means": 1, "drive_steps": 1, "vae_updates": 1,
    "mdnrnn_updates": 1, "gate_drives": 0, "gate_losses": 0, "seed": 0, "local": 0, "jobs": 1,
    "views": 0, "gate_lives": 0,
}  # fmt: skip


@dataclass(frozen=True)
class IterateConfig:
    """How many rounds, and what each drives, learns, dreams and is held to."""

    init: str = option("", "controller to go on from, with its world model: a file, or one that ships (default none)")
    rounds: int = option(5, "rounds in all: each makes a world model and evolves in its dream; more may follow later")
    task: str = option("", f"the world, as gym:ENVIRONMENT (default {FIRST_WORLD}); as `collect` takes this and these:")
    environment: tuple[str, ...] = option((), "KEY=VALUE arguments of the world; values as in JSON")
    observation: str = option("", "picture among several, by its key; render: what is drawn")
    crop: str = option("", "part of the picture that is seen, as top:bottom,left:right")
    size: int | None = option(None, "height and width of the picture: 64 or 96")
    skip: int | None = option(None, "steps of the world for which an action is held")
    difference: bool = option(False, "show movement: grey now, grey before, their difference")
    preset: str | None = option(
        None,
        f"training preset, whose settings flags may change: {', '.join(NAMES['training'])} (default the world's, such "
        "as tiny)",
    )
    drives: int | None = option(None, "random drives that the first round learns from (default the preset's)")
    more_drives: int = option(0, "random drives that each later round adds")
    own_drives: int = option(80, "drives of the last round's own means, or --init's, that each round adds")
    means: int = option(4, "means that drive these: the reported one, the last one, then the best evaluated ones")
    noise: float = option(0.3, "on the actions of these drives, in halves of an action's range")
    spells: float = option(0.0, "chance of each of their steps that an action which rests, as a brake, is tried")
    drive_steps: int | None = option(None, "steps of a drive at most (default the preset's)")
    vae: Literal["decoder", "whole", "keep"] = option("decoder", "the part of the VAE that learns on in later rounds")
    vae_updates: int | None = option(
        None, f"updates of the VAE in later rounds (default as --vae-flags say, else {LATER_UPDATES['vae']})"
    )
    mdnrnn_updates: int | None = option(
        None,
        f"updates of the MDN-RNN in each later round (default what --mdnrnn-flags say, else {LATER_UPDATES['mdnrnn']})",
    )
    vae_flags: str = option("", 'flags of `train vae` in every round, as one text: "--updates 900 --batch 50"')
    mdnrnn_flags: str = option("", "flags of `train mdnrnn` in every round")
    bundle_flags: str = option("", "flags of `bundle` in every round, such as --reward value")
    run_flags: str = option(
        "--generations 32", "flags of each round's `coordinator`, whose preset is the world's unless another is named"
    )
    later_run_flags: str = option("", "flags that follow these wherever a world model came before: --temperature 1")
    go_on: bool = option(False, "begin each evolution at the last optimum, fitted to the new model, instead of at zero")
    subspace: bool = option(False, "search only what each model foretells of the last drives: needs --go-on")
    views: int = option(0, "beside it so many directions that foretell coming views, as `lab subspace` finds them")
    gate_drives: int = option(20, "drives of `inspect --probe` that a new world model is held to the old by; 0: none")
    gate_losses: int = option(30, "losses of `inspect --losses` that it is held to it by; 0: none")
    gate_lives: int | None = option(
        None,
        "episodes of each fixed policy of `inspect --survival` that it is held to it by; 0: none (default "
        f"{SURVIVAL_EPISODES} with --task, else none)",
    )
    seed: int = option(0, "makes the iteration: drives, training, populations and seeds of episodes follow from it")
    local: int | None = option(None, "scoring processes here (default one a core, or none where --listen is given)")
    jobs: int | None = option(None, "processes that drive for the data set here (default one a core)")
    device: Literal["cpu", "cuda", "auto"] = option("cpu", "that trains: cpu, cuda, or auto")

    def __post_init__(self) -> None:
        for name, least in LEAST.items():
            value = getattr(self, name)
            if value is not None and value < least:
                raise UsageError(f"--{name.replace('_', '-')} must be at least {least}, not {value}")
        check_preset("training", self.training_preset)
        if not 0 <= self.noise <= 10:
            raise UsageError(f"--noise must be from 0 to 10, not {self.noise}")
        if not 0 <= self.spells <= 1:
            raise UsageError(f"--spells must be from 0 to 1, not {self.spells}")
        if self.gate_drives == 1 or 0 < self.gate_losses < 4:  # as worker/addons/inspection/measure.py
            raise UsageError("--gate-drives must be 0 or at least 2, --gate-losses 0 or at least 4")
        if self.subspace and not self.go_on:
            raise UsageError("--subspace changes an existing controller: give --go-on too")
        if self.views and not self.subspace:
            raise UsageError("--views are beside the features of --subspace: give that too")
        if self.seed > MOST_SEED:
            raise UsageError(f"--seed must be at most {MOST_SEED}, not {self.seed}")
        for name in ("vae_flags", "mdnrnn_flags", "bundle_flags", *RUN_FLAGS):
            self.flags(name)

    @property
    def training_preset(self) -> str:
        """The preset of its data and trainings: by default that of its world."""
        return self.preset or default_training_preset(self.task)

    @property
    def survival_episodes(self) -> int:
        """Episodes of each policy by which a gate measures survival; 0: it does not."""
        return (SURVIVAL_EPISODES if self.task else 0) if self.gate_lives is None else self.gate_lives

    def is_from_scratch(self, number: int) -> bool:
        """Whether a round has nothing before it: no world model, no controller."""
        return number == 1 and not self.init

    def flags_of_run(self, number: int) -> Words:
        """The flags of a round's `coordinator`; of one that is given twice the latter counts."""
        names = RUN_FLAGS[:1] if self.is_from_scratch(number) else RUN_FLAGS
        return tuple(word for name in names for word in self.flags(name))

    def flags(self, name: str) -> Words:
        """The flags that a setting such as `vae_flags` holds as one text; `UsageError` for those that iterate sets."""
        reserved = () if name in RUN_FLAGS else RESERVED_FLAGS
        return split_flags(f"--{name.replace('_', '-')}", getattr(self, name), "iterate", reserved)
