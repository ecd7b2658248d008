"""`dreamfleet inspect`: a page about a world model or trainings, or figures of what a model knows and how it dreams."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_rows
from dreamfleet.common.cli.progress import progress_bar
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.unseen_drawing import draw_unseen
from dreamfleet.common.runs.seeds import VALIDATION
from dreamfleet.worker.addons.inspection.measure import (
    DRIVES,
    FEWEST_DRIVES,
    FEWEST_LOSSES,
    FIGURES,
    LIVES,
    LOSSES,
    FigureName,
    FigureReport,
    MeasureRequest,
    measure,
)

if TYPE_CHECKING:
    from dreamfleet.worker.addons.inspection.page import Section
    from dreamfleet.worker.addons.inspection.subject import InspectionSubject

SUMMARY = "look into a world model: what it sees, keeps and dreams, and how it learnt, as one page, or as figures"
EXTRAS = ("worker", "views")
FIRST = "--out --data --picture --controller --seed --steps --probe --losses --likeness --survival --episodes --json"
WORDS = ("quantity", "begun", "mean", "policy")  # columns of the figures that are no numbers
SECTIONS = 14  # at most, and one more a data folder


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument(
        "subject", metavar="BUNDLE|RUN", nargs="?",
        help="a bundle's file, one that ships, or a run; for figures it may be left out: the --controller's",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, default=Path("inspection"), help="folder to write (default inspection)")
    parser.add_argument(
        "--data", type=Path, nargs="+", default=[], metavar="FOLDER",
        help="data folders, whose loss curves are drawn on one axis: the one that it was trained in, or trainings to "
        "compare, with or without a bundle before them; without one, their VAEs are looked into too",
    )  # fmt: skip
    parser.add_argument(
        "--picture", type=Path, nargs="+", default=[], metavar="FILE",
        help="pictures of your own, PNG or JPEG: what the bundle's VAE, else that of --data, sees and decodes of them",
    )  # fmt: skip
    first = VALIDATION.start
    parser.add_argument("--seed", type=int, default=first, help=f"the (first) seed that is driven (default {first})")
    parser.add_argument("--steps", type=int, default=300, help="steps of the page's drive (default 300)")
    parser.add_argument(
        "--action", type=float, nargs="+", metavar="N",
        help="the page's drive does this at each step, instead of a driver: a number for each part of an action, such "
        "as steering, gas and brake --action -0.01 1 0, or the number of a choice, from 0",
    )  # fmt: skip
    figures = parser.add_argument_group("figures, printed instead of the page")
    figures.add_argument("--probe", action="store_true", help="how much of the simulator's truth [z, h] holds")
    figures.add_argument("--losses", action="store_true", help="whether dreams lose the road where reality lost it")
    figures.add_argument(
        "--likeness", action="store_true", help="whether rare events of drives are as frequent in dreams"
    )
    figures.add_argument(
        "--survival", action="store_true",
        help="whether fixed policies, and the --controller, live as long in dreams as in reality",
    )  # fmt: skip
    parser.add_argument("--controller", help="who drives: a file, a run, or one that ships (default the run's own)")
    figures.add_argument(
        "--driver", help="who drives for --probe, from anywhere where the world can: one of `collect --driver`",
    )  # fmt: skip
    figures.add_argument(
        "--episodes", type=int, help=f"drives of --probe and --likeness (default {DRIVES}, at least {FEWEST_DRIVES}), "
        f"losses of --losses (default {LOSSES}, at least {FEWEST_LOSSES}), episodes of each policy of --survival "
        f"(default {LIVES})",
    )  # fmt: skip
    figures.add_argument(
        "--noise", type=float, default=MeasureRequest.noise,
        help="added to actions, in halves of their range; of choices the share of steps with another "
        f"(default {MeasureRequest.noise})",
    )  # fmt: skip
    figures.add_argument("--temperature", type=float, help="of the dreams (default the run's, else 1.0)")
    figures.add_argument(
        "--end", default="", help="when dreams of --survival end: drawn, or above a probability (default the bundle's)"
    )
    add_global_flags(parser, "runs_dir")
    add_json_flag(parser)


def run(args: argparse.Namespace) -> int:
    """Write the page and print its path, or measure and print figures."""
    draw_unseen()
    if args.end and not args.survival:
        raise UsageError("--end needs the dreams of --survival: give that too")
    if figures := tuple(name for name in FIGURES if getattr(args, name)):
        for flag in ("picture", "action"):
            if getattr(args, flag):
                raise UsageError(f"--{flag} belongs to the page: omit --probe, --losses, --likeness and --survival")
        return _measure(args, figures)
    if args.driver:
        raise UsageError("--driver drives for figures: give --probe too")
    if not args.subject and not args.data:
        raise UsageError("give a bundle or a run to look into, or --data folders whose trainings to draw")
    return _draw_page(args)


def _draw_page(args: argparse.Namespace) -> int:
    if args.steps < 2 or args.seed < 0:
        raise UsageError("--steps must be at least 2 and --seed at least 0")
    if args.action and args.controller:
        raise UsageError("only one can drive: give --controller or --action")
    from dreamfleet.worker.addons.inspection.encoded_rollout import DriveConfig
    from dreamfleet.worker.addons.inspection.page_builder import write_page
    from dreamfleet.worker.addons.inspection.subject import find_subject

    with find_subject(args.subject, args.runs_dir) as found:
        subject = _with_driver(args, found)
        if args.action and subject.bundle is None:
            raise UsageError("--action is driven beside a world model's dream: name a bundle, or a run with one")
        sections = SECTIONS + len(args.data)
        config = DriveConfig(args.seed, args.steps, tuple(args.action or ()))
        figures = dict[str, Any]()
        with progress_bar("inspect", sections, "sections") as bar:

            def on_section(done: int, section: Section) -> None:
                bar.update(done, section.name)
                figures.update(section.figures)

            page = write_page(subject, args.out, config, args.data, on_section, args.picture)
            bar.update(sections)
    print_answer(args, str(page), page=page, **figures)
    return 0


def _measure(args: argparse.Namespace, figures: tuple[FigureName, ...]) -> int:
    request = MeasureRequest(
        figures, args.subject, args.controller, args.driver, args.episodes, args.seed, args.noise, args.temperature,
        args.end, args.runs_dir,
    )  # fmt: skip

    def show(_name: FigureName, found: FigureReport) -> None:
        rows, text = found.table()
        print_rows(rows, right=tuple(name for name in rows[0] if name not in WORDS))
        print(text)

    if args.json:
        print_answer(args, "", **measure(request).facts)
    else:
        measure(request, on_figure=show)
    return 0


def _with_driver(args: argparse.Namespace, subject: InspectionSubject) -> InspectionSubject:
    """The subject, with the driver of its page if one is given."""
    if not args.controller:
        return subject
    from dreamfleet.worker.addons.inspection.subject import choose_driver

    bundle, driving = choose_driver(subject, args.controller, args.runs_dir)
    controller, own = driving.controller, driving.own
    assert controller is not None  # it was named
    assert own is not None
    if controller.bundle == bundle.sha256:
        return replace(subject, bundle=bundle.for_controller(controller), controller=controller)
    return replace(subject, bundle=bundle, controller=controller, own=own.for_controller(controller))
