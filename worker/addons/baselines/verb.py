"""`dreamfleet baseline train|export`: agents without a world model, by the judge of controllers."""

import argparse
import sys
from pathlib import Path

from dreamfleet.common.cli.command_line import SimpleVerb
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_next
from dreamfleet.common.cli.presets import check_preset, preset_help_text
from dreamfleet.common.cli.progress import progress_bar
from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import check_output_path
from dreamfleet.common.host.processes import shell_command
from dreamfleet.common.host.stop_signals import stop_on_signals
from dreamfleet.common.host.unseen_drawing import draw_unseen
from dreamfleet.common.printable import plural
from dreamfleet.worker.addons.baselines.presets import CHECKPOINT, DRQN, NAMES, PRESETS
from dreamfleet.worker.addons.baselines.progress import TrainingReport
from dreamfleet.worker.training.config_flags import add_config_flags, add_settings_flag, apply_settings
from dreamfleet.worker.training.stages.train import explain_interrupt

LEARNING_FLAGS = ("episodes", "steps", "seed")  # other settings are keys of --set
TABLE = "baseline"


def _check_learns(agent: str, hint: str) -> None:
    if agent != DRQN:
        raise UsageError(f"{agent} learns nothing: {hint}")


def configure_train(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `baseline train`."""
    parser.add_argument("agent", choices=NAMES, help="drqn; random drivers learn nothing")
    parser.add_argument("--data", type=Path, required=True, help="folder of the training and of the trained network")
    parser.add_argument("--preset", default="learning", help=f"{preset_help_text('baseline')} (default learning)")
    parser.add_argument("--device", default="cpu", help="cpu, cuda, or auto (default cpu)")
    parser.add_argument("--new", action="store_true", help="start over, replacing the checkpoint that is there")
    learning = {name: each.learning for name, each in PRESETS.items()}
    add_config_flags(parser, "learning", learning, LEARNING_FLAGS)
    add_settings_flag(parser, {TABLE: (learning, {name: each.agent for name, each in PRESETS.items()})}, LEARNING_FLAGS)
    add_json_flag(parser)


def train_baseline(args: argparse.Namespace) -> int:
    """Train, with a report every few episodes on stderr, and print the figures."""
    _check_learns(args.agent, f"`{shell_command('evaluate', '--controller', args.agent)}` judges it")
    preset = PRESETS[check_preset("baseline", args.preset)]
    config, layers = apply_settings((preset.learning, preset.agent), TABLE, args)
    draw_unseen()
    from dreamfleet.worker.addons.baselines.train import train_drqn
    from dreamfleet.worker.training.training_state import select_device

    def report_progress(episodes: int, report: TrainingReport | None) -> None:
        bar.update(episodes)
        if report is not None:
            print(report, file=sys.stderr, flush=True)

    device = select_device(args.device)
    with (
        progress_bar(DRQN, config.episodes, "episodes") as bar,
        explain_interrupt(args.data / CHECKPOINT, args.new),
        stop_on_signals() as stop,
    ):
        figures = train_drqn(args.data, layers, config, report_progress, device, stop, args.new)
    print_answer(args, "  ".join(f"{name} {value}" for name, value in figures.items()), **figures)
    print_next(args, ("baseline", "export", args.agent, "--data", args.data, "--out", args.data / f"{args.agent}.zip"))
    return 0


def configure_export(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `baseline export`."""
    parser.add_argument("agent", choices=NAMES, help="drqn; a random driver has nothing to export")
    parser.add_argument("--data", type=Path, required=True, help="the folder of its training")
    parser.add_argument("--out", type=Path, required=True, help="the file to write, NAME.zip")
    add_json_flag(parser)


def export_baseline(args: argparse.Namespace) -> int:
    """Export, and print the agent's identity."""
    _check_learns(args.agent, "there is nothing to export")
    check_output_path(args.out)
    from dreamfleet.worker.addons.baselines.export import export_agent

    agent = export_agent(args.data)
    agent.save(args.out)
    provenance, size = agent.manifest.provenance, args.out.stat().st_size
    text = (
        f"{args.out}: {size / 1e6:.1f} MB, sha256 {agent.sha256}, after {plural(provenance['episodes'], 'episode')}, "
        f"{plural(provenance['steps'], 'step')} and {plural(provenance['updates'], 'update')}"
    )
    trained = {name: provenance[name] for name in ("episodes", "steps", "updates")}
    print_answer(args, text, agent=args.out, bytes=size, sha256=agent.sha256, **trained)
    print_next(args, ("evaluate", "--controller", args.out), ("record", "--controller", args.out))
    return 0


TRAIN = SimpleVerb(
    "train a network that drives from rewards alone, without a world model, or continue its training",
    configure_train,
    train_baseline,
    EXTRAS=("train",),
    FIRST="--preset --device --new --episodes --steps --seed --set --json",
)
EXPORT = SimpleVerb(
    "write a trained baseline as one file, which `evaluate --controller` and `record` take without torch",
    configure_export,
    export_baseline,
    EXTRAS=("train",),
)
