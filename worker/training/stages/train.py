"""Training: a world model's VAE or MDN-RNN on a data set. Nothing here loads torch before a stage runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from dreamfleet.common.errors import StoppedError, UsageError
from dreamfleet.common.files.locks import folder_lock
from dreamfleet.common.host.stop_signals import Stop, never_stop
from dreamfleet.worker.training.stages import StageReport

if TYPE_CHECKING:
    from torch import nn

    from dreamfleet.worker.training.presets import TrainConfig

Model = Literal["vae", "mdnrnn"]
VAE: Final = "vae"
MDNRNN: Final = "mdnrnn"
MODELS: tuple[Model, ...] = (VAE, MDNRNN)
SPOKEN = {VAE: "VAE", MDNRNN: "MDN-RNN"}


@dataclass(frozen=True)
class TrainRequest:
    """A training, begun or to be resumed. Without a preset it has that of the data set, else of its world.

    `settings` are the fields of `TrainConfig` and of the model's layers that differ from the preset's. `device` is cpu,
    cuda or auto. It begins from the weights in `continue_from`; `new` replaces what the folder has. `decoder_only`
    leaves a VAE's encoder as it is. `tensorboard` is a folder for its events.
    """

    model: Model
    data: Path
    preset: str | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    device: str = "cpu"
    continue_from: Path | None = None
    new: bool = False
    decoder_only: bool = False
    tensorboard: Path | None = None

    def __post_init__(self) -> None:
        if self.decoder_only and self.model != VAE:
            raise UsageError("--decoder-only is of the VAE: omit it")

    def resolve(self) -> tuple[TrainConfig, Any]:
        """The training's configuration, and the layers; `UsageError` for what cannot be."""
        from dreamfleet.worker.training.config_flags import override
        from dreamfleet.worker.training.data.data_folder import resolve_preset
        from dreamfleet.worker.training.presets import find_preset

        preset = find_preset(resolve_preset(self.data, self.preset))
        config, layers = (preset.vae, preset.vae_layers) if self.model == VAE else (preset.mdnrnn, preset.mdnrnn_layers)
        return override(config, self.settings), override(layers, self.settings)


@dataclass(frozen=True)
class EarlyStop:
    """Patience ended after update `given_up_at`; the checkpoint is of `update`, which has the best held-out loss."""

    update: int
    held_out_loss: float
    given_up_at: int

    def __str__(self) -> str:
        return (
            f"ended early after update {self.given_up_at}, as --patience says: the checkpoint is that of update "
            f"{self.update}, the best on held-out drives (loss {self.held_out_loss:.4g}); --patience 0 continues"
        )


@dataclass(frozen=True)
class TrainReport(StageReport):
    """The model's figures on held-out episodes, by name, and how its training ended early, if it did."""

    figures: Mapping[str, float]
    ended_early: EarlyStop | None

    def __str__(self) -> str:
        text = "  ".join(f"{name} {value}" for name, value in self.figures.items())
        return text if self.ended_early is None else f"{self.ended_early}\n{text}"

    @property
    def facts(self) -> dict[str, Any]:
        """The figures, and how it ended early."""
        return {**self.figures, "ended_early": self.ended_early and asdict(self.ended_early)}


@dataclass(frozen=True)
class ModelSummary(StageReport):
    """A model's layers, a line each, and the number of its trainable parameters."""

    summary: tuple[str, ...]
    parameters: int

    def __str__(self) -> str:
        return "\n".join(self.summary)


def train_model(request: TrainRequest, stop: Stop = never_stop) -> TrainReport:
    """Train to the end, with a progress bar on stderr, and store the figures beside the data.

    `StoppedError` says what is kept. `UsageError` while another process trains the same model in the folder: each would
    overwrite the other's. `DatasetError` for what it cannot learn from.
    """
    from dreamfleet.worker.training.torch_setup import configure_process

    configure_process()  # before torch is loaded
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.training import train_mdnrnn, train_vae
    from dreamfleet.worker.training.assemble import record_quality
    from dreamfleet.worker.training.checkpoint import check_config
    from dreamfleet.worker.training.training_state import select_device

    config, layers = request.resolve()
    data, name = request.data, SPOKEN[request.model]
    checkpoint = data / (train_vae if request.model == VAE else train_mdnrnn).CHECKPOINT
    if request.model == VAE and not request.new and checkpoint.exists():
        check_config(checkpoint, layers)  # before a bar is drawn
    with (
        # a folder without data is none to make
        folder_lock(checkpoint.with_suffix(".lock"), f"training of the {name}") if data.is_dir() else nullcontext(),
        progress_bar(name, config.updates, "updates") as bar,
        explain_interrupt(checkpoint, request.new),
    ):
        common: dict[str, Any] = {
            "device": select_device(request.device), "continue_from": request.continue_from, "stop": stop,
            "new": request.new, "events": request.tensorboard,
        }  # fmt: skip
        if request.model == VAE:
            only = request.decoder_only
            figures = train_vae.train_vae(data, config, bar.update, layers, decoder_only=only, **common)
        else:
            figures = train_mdnrnn.train_mdnrnn(data, config, bar.update, layers, **common)
    record_quality(data, figures)
    return TrainReport(figures, find_early_stop(checkpoint))


def summarise(request: TrainRequest, _stop: Stop = never_stop) -> ModelSummary:
    """The layers of the model that would be trained; `DatasetError` if the one to continue from has others."""
    from dreamfleet.worker.training.torch_setup import configure_process

    configure_process()  # before torch is loaded
    from dreamfleet.worker.training.train_mdnrnn import fit_layers
    from dreamfleet.worker.training.training_state import count_parameters, summarise_model
    from dreamfleet.worker.worldmodel import mdnrnn, vae
    from dreamfleet.worker.worldmodel.mdnrnn_config import ADDABLE_HEADS

    _, layers = request.resolve()
    model: nn.Module
    if request.model == VAE:
        model, addable = vae.VAE(layers), frozenset[str]()
    else:
        model = mdnrnn.MDNRNN(fit_layers(layers, request.data, request.continue_from, request.new))
        addable = ADDABLE_HEADS
    lines = summarise_model(model, request.continue_from, addable).splitlines()
    return ModelSummary(tuple(lines), count_parameters(model))


def find_early_stop(path: Path) -> EarlyStop | None:
    """How the training of this checkpoint ended early; None if it did not."""
    from dreamfleet.worker.training.checkpoint import load_progress

    progress = load_progress(path)
    if progress.get("stopped") is None:
        return None
    return EarlyStop(progress["update"], progress["best"], progress.get("given_up_at", progress["update"]))


@contextmanager
def explain_interrupt(path: Path, new: bool) -> Iterator[None]:
    """On a second Ctrl-C, which ends a training within an update, report what its checkpoint keeps."""
    from dreamfleet.worker.training.checkpoint import load_progress
    from dreamfleet.worker.training.training_state import resume_command

    try:
        yield
    except KeyboardInterrupt as error:
        if not path.exists():
            raise
        raise StoppedError(
            f"interrupted: {path} keeps what was made up to update {load_progress(path)['update']}; "
            f"{resume_command(new)} continues from there"
        ) from error
