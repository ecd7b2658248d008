"""`dreamfleet inspect`: a page about a world model or trainings, or figures of what a model knows and how it dreams."""

from __future__ import annotations

import argparse
import os
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.errors import UsageError
from dreamfleet.common.listing import add_json, answer, print_rows
from dreamfleet.common.seeds import VALIDATION
from dreamfleet.common.site import offer
from dreamfleet.common.threads import pin_thread_pools

if TYPE_CHECKING:
    from dreamfleet.common.bundle import Bundle
    from dreamfleet.worker.inspection.inspection import Subject
    from dreamfleet.worker.inspection.measuring import Driving
    from dreamfleet.worker.inspection.witness import WitnessConfig

SUMMARY = "look into a world model: what it sees, keeps and dreams, and how it learnt, as one page, or as figures"
EXTRAS = ("worker", "views")
SECTIONS = 11  # at most, and one more a data folder
DRIVES, LOSSES = 20, 30
FEWEST_DRIVES, FEWEST_LOSSES = 2, 4


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
    parser.add_argument("--seed", type=int, default=first, help=f"the (first) track that is driven (default {first})")
    parser.add_argument("--steps", type=int, default=300, help="steps of the page's drive (default 300)")
    parser.add_argument(
        "--action", type=float, nargs="+", metavar="N",
        help="the page's drive does this at each step, and nobody drives: of CarRacing steering, gas and brake, "
        "such as --action -0.01 1 0",
    )  # fmt: skip
    figures = parser.add_argument_group("figures, printed instead of the page")
    figures.add_argument("--probe", action="store_true", help="how much of the simulator's truth [z, h] holds")
    figures.add_argument("--losses", action="store_true", help="whether dreams lose the road where reality lost it")
    figures.add_argument("--likeness", action="store_true", help="whether dreams hold what is rare on drives as often")
    parser.add_argument("--controller", help="who drives: a file, a run, or one that ships (default the run's own)")
    figures.add_argument(
        "--driver", help="who drives for --probe, from anywhere: of CarRacing those of `collect --driver`, which are "
        "random, held, ornstein-uhlenbeck, random-walk, uniform, pushed and network",
    )  # fmt: skip
    figures.add_argument(
        "--episodes", type=int, help=f"drives of --probe and --likeness (default {DRIVES}, at least {FEWEST_DRIVES}), "
        f"losses of --losses (default {LOSSES}, at least {FEWEST_LOSSES})",
    )  # fmt: skip
    figures.add_argument("--noise", type=float, default=0.3, help="added to actions, of half their range (default 0.3)")
    figures.add_argument("--temperature", type=float, help="of the dreams (default the run's, else 1.0)")
    offer(parser, "runs_dir")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Draw and print where the page lies, or measure and print figures."""
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    if args.probe or args.losses or args.likeness:
        if args.picture:
            raise UsageError("--picture is of the page: leave --probe, --losses and --likeness out")
        if args.action:
            raise UsageError("--action is of the page: leave --probe, --losses and --likeness out")
        return _measure(args)
    if args.driver:
        raise UsageError("--driver drives for figures: give --probe too")
    if not args.subject and not args.data:
        raise UsageError("give a bundle or a run to look into, or --data folders whose trainings to draw")
    return _draw(args)


def _draw(args: argparse.Namespace) -> int:
    if args.steps < 2 or args.seed < 0:
        raise UsageError("--steps must be at least 2 and --seed at least 0")
    if args.action and args.controller:
        raise UsageError("one drives: give --controller or --action")
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.worker.inspection.inspection import inspect
    from dreamfleet.worker.inspection.rollout import DriveConfig

    with ExitStack() as held:
        subject = _driven(args, _found(args, held))
        if args.action and subject.bundle is None:
            raise UsageError("--action is driven beside a world model's dream: name a bundle, or a run with one")
        sections = SECTIONS + len(args.data)
        config = DriveConfig(args.seed, args.steps, tuple(args.action or ()))
        bar = held.enter_context(progress_bar("inspect", sections, "sections"))
        page = inspect(subject, args.out, config, args.data, bar.move, args.picture)
        bar.move(sections)
    answer(args, str(page), page=page)
    return 0


def _measure(args: argparse.Namespace) -> int:
    pin_thread_pools()  # of NumPy, which is not loaded yet
    from dreamfleet.worker.inspection.witness import WitnessConfig

    _check(args)
    with ExitStack() as held:
        subject = _subject(args, held)
        bundle, driving = _choose(args, subject)
        config = WitnessConfig(args.noise, first_seed=args.seed, anywhere=bool(driving.driver))
        found: dict[str, Any] = {"bundle": bundle.sha256, "noise": args.noise, "first_seed": args.seed}
        found["driver"] = driving.driver or (driving.controller and driving.controller.sha256)
        if args.probe:
            found["probe"] = _probe(args, bundle, driving, config)
        if args.likeness:
            found["likeness"] = _liken(args, bundle, driving, config, _temperature(args, subject))
        if args.losses:
            found["losses"] = _lose(args, bundle, driving, config, _temperature(args, subject))
    if args.json:
        answer(args, "", **found)
    return 0


def _probe(args: argparse.Namespace, bundle: Bundle, driving: Driving, config: WitnessConfig) -> dict[str, Any]:
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.worker.inspection.measuring import probe
    from dreamfleet.worker.inspection.tables import knowledge_rows, knowledge_text

    drives = DRIVES if args.episodes is None else args.episodes
    with progress_bar("probe", drives, "drives") as bar:
        known = probe(bundle, driving, config, drives, bar.move)
    if not args.json:
        rows = knowledge_rows(known)
        print_rows(rows, right=tuple(rows[0])[1:])
        print(knowledge_text(known))
    return asdict(known)


def _liken(
    args: argparse.Namespace, bundle: Bundle, driving: Driving, config: WitnessConfig, temperature: float
) -> dict[str, Any]:
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.worker.inspection.losses import LossConfig
    from dreamfleet.worker.inspection.measuring import likeness
    from dreamfleet.worker.inspection.tables import LIKENESS, likeness_rows

    drives, wanted = DRIVES if args.episodes is None else args.episodes, LossConfig(temperature=temperature)
    with progress_bar("likeness", drives, "drives") as bar:
        compared = likeness(bundle, driving, config, wanted, drives, bar.move)
    if not args.json:
        rows = likeness_rows(compared)
        print_rows(rows, right=tuple(rows[0])[1:])
        print(LIKENESS)
    facts = {"drives": drives, "dreams": wanted.dreams, "temperature": wanted.temperature}
    return {**facts, "quantities": [asdict(each) for each in compared]}


def _lose(
    args: argparse.Namespace, bundle: Bundle, driving: Driving, config: WitnessConfig, temperature: float
) -> dict[str, Any]:
    from dreamfleet.common.progress import progress_bar
    from dreamfleet.worker.inspection.losses import LossConfig
    from dreamfleet.worker.inspection.measuring import dream_losses
    from dreamfleet.worker.inspection.tables import loss_rows, loss_text

    wanted = LossConfig(LOSSES if args.episodes is None else args.episodes, temperature=temperature)
    with progress_bar("losses", wanted.losses, "losses") as bar:
        compared, drives = dream_losses(bundle, driving, config, wanted, bar.move)
    if not args.json:
        rows = loss_rows(compared)
        print_rows(rows, right=("n", *tuple(rows[0])[3:]))
        print(loss_text(drives, wanted.dreams, config.lasting))
    facts = {"drives": drives, "dreams": wanted.dreams, "temperature": wanted.temperature, "lasting": config.lasting}
    return {**facts, "begun": [asdict(each) for each in compared]}


def _driven(args: argparse.Namespace, subject: Subject) -> Subject:
    """The subject with who drives for its page, where that is said."""
    if not args.controller:
        return subject
    bundle, driving = _choose(args, subject)
    controller, own = driving.controller, driving.own
    if controller is None or own is None:
        raise UsageError(f"controller {args.controller} sees no world model: give one that was evolved with one")
    if controller.bundle == bundle.sha256:
        return replace(subject, bundle=bundle.fitting(controller), controller=controller)
    return replace(subject, bundle=bundle, controller=controller, own=own.fitting(controller))


def _check(args: argparse.Namespace) -> None:
    fewest, what = (FEWEST_LOSSES, "losses, for --losses") if args.losses else (FEWEST_DRIVES, "drives")
    if args.episodes is not None and args.episodes < fewest:
        raise UsageError(f"--episodes must be at least {fewest} {what}, not {args.episodes}")
    if args.seed < 0 or not 0 <= args.noise <= 10:
        raise UsageError("--seed must be at least 0, --noise from 0 to 10")
    if args.controller and args.driver:
        raise UsageError("one drives: give --controller or --driver")


def _subject(args: argparse.Namespace, held: ExitStack) -> Subject:
    subject = _found(args, held)
    if args.subject and subject.bundle is None:
        raise UsageError(f"run {args.subject} has no world model to measure: name a bundle, or a run with one")
    return subject


def _found(args: argparse.Namespace, held: ExitStack) -> Subject:
    from dreamfleet.worker.inspection.inspection import Subject, find_subject

    return held.enter_context(find_subject(args.subject, args.runs_dir)) if args.subject else Subject(None)


def _temperature(args: argparse.Namespace, subject: Subject) -> float:
    from dreamfleet.worker.dream.batch import DEFAULT_TEMPERATURE

    if args.temperature is not None:
        return float(args.temperature)
    return (subject.run.spec.temperature if subject.run else 0.0) or DEFAULT_TEMPERATURE


def _choose(args: argparse.Namespace, subject: Subject) -> tuple[Bundle, Driving]:
    """What is measured, and who drives."""
    from dreamfleet.common.shelf import bundle_for, find_controller
    from dreamfleet.worker.inspection.measuring import Driving

    controller, own = subject.controller, subject.bundle
    if args.controller:
        controller, beside = find_controller(args.controller, args.runs_dir)
        if own is None or controller.bundle != own.sha256:
            own = bundle_for(controller, None, beside)
    bundle = subject.bundle or own
    if bundle is None:
        raise UsageError("give a bundle or a run to measure, or a --controller that has a world model")
    if args.driver:
        return bundle, Driving(driver=args.driver)
    if controller is None:
        raise UsageError("nobody drives: give --controller, or for --probe a --driver")
    return bundle, Driving(controller, own)
