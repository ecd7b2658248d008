"""`dreamfleet inspect`: a page about a world model or trainings, or figures of what a model knows and how it dreams."""

from __future__ import annotations

import argparse
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dreamfleet.common.cli.global_config import add_global_flags
from dreamfleet.common.cli.output import add_json_flag, print_answer, print_rows
from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.host.unseen_drawing import draw_unseen
from dreamfleet.common.runs.seeds import VALIDATION

if TYPE_CHECKING:
    from dreamfleet.common.artifacts.bundle import Bundle
    from dreamfleet.worker.inspection.disturbed_rollouts import DisturbedDriveConfig
    from dreamfleet.worker.inspection.measurements import DriverChoice
    from dreamfleet.worker.inspection.page_builder import InspectionSubject

SUMMARY = "look into a world model: what it sees, keeps and dreams, and how it learnt, as one page, or as figures"
EXTRAS = ("worker", "views")
SECTIONS = 12  # at most, and one more a data folder
DRIVES, LOSSES, LIVES = 20, 30, 40
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
        "--noise", type=float, default=0.3,
        help="added to actions, in halves of their range; of choices the share of steps with another (default 0.3)",
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
    if args.probe or args.losses or args.likeness or args.survival:
        if args.picture:
            raise UsageError("--picture belongs to the page: omit --probe, --losses, --likeness and --survival")
        if args.action:
            raise UsageError("--action belongs to the page: omit --probe, --losses, --likeness and --survival")
        return _measure(args)
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
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.inspection.encoded_rollout import DriveConfig
    from dreamfleet.worker.inspection.page_builder import write_page

    with ExitStack() as held:
        subject = _with_driver(args, _open_subject(args, held))
        if args.action and subject.bundle is None:
            raise UsageError("--action is driven beside a world model's dream: name a bundle, or a run with one")
        sections = SECTIONS + len(args.data)
        config = DriveConfig(args.seed, args.steps, tuple(args.action or ()))
        bar = held.enter_context(progress_bar("inspect", sections, "sections"))
        page = write_page(subject, args.out, config, args.data, bar.update, args.picture)
        bar.update(sections)
    print_answer(args, str(page), page=page)
    return 0


def _measure(args: argparse.Namespace) -> int:
    pin_thread_pools()  # of NumPy, which is not loaded yet
    from dreamfleet.worker.dream.world import world_of
    from dreamfleet.worker.inspection.disturbed_rollouts import DisturbedDriveConfig
    from dreamfleet.worker.tasks.api import TaskWithBeginnings
    from dreamfleet.worker.tasks.registry import task_of

    _check_figure_flags(args)
    with ExitStack() as held:
        subject = _open_measured_subject(args, held)
        bundle, driving = _choose_driver(args, subject)
        task = task_of(bundle)
        config = DisturbedDriveConfig(
            args.noise, first_seed=args.seed, opening=world_of(bundle).opening,
            anywhere=bool(driving.driver) and isinstance(task, TaskWithBeginnings),
        )  # fmt: skip
        found: dict[str, Any] = {"bundle": bundle.sha256, "noise": args.noise, "first_seed": args.seed}
        found["driver"] = driving.driver or (driving.controller and driving.controller.sha256)
        if args.survival:
            found["survival"] = _measure_survival(args, bundle, driving, _temperature(args, subject))
        if args.probe:
            found["probe"] = _measure_probe(args, bundle, driving, config)
        if args.likeness:
            found["likeness"] = _measure_likeness(args, bundle, driving, config, _temperature(args, subject))
        if args.losses:
            found["losses"] = _measure_losses(args, bundle, driving, config, _temperature(args, subject))
    if args.json:
        print_answer(args, "", **found)
    return 0


def _measure_probe(
    args: argparse.Namespace, bundle: Bundle, driving: DriverChoice, config: DisturbedDriveConfig
) -> dict[str, Any]:
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.inspection.measurements import probe
    from dreamfleet.worker.inspection.tables import knowledge_rows, knowledge_text

    drives = DRIVES if args.episodes is None else args.episodes
    with progress_bar("probe", drives, "drives") as bar:
        known = probe(bundle, driving, config, drives, bar.update)
    if not args.json:
        rows = knowledge_rows(known)
        print_rows(rows, right=tuple(rows[0])[1:])
        print(knowledge_text(known))
    return asdict(known)


def _measure_survival(
    args: argparse.Namespace, bundle: Bundle, driving: DriverChoice, temperature: float
) -> dict[str, Any]:
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.dream.world import world_of
    from dreamfleet.worker.inspection.survival import SurvivalConfig, fixed_drivers, measure_survival
    from dreamfleet.worker.inspection.tables import survival_rows, survival_text
    from dreamfleet.worker.tasks.registry import task_of

    episodes = LIVES if args.episodes is None else args.episodes
    wanted = SurvivalConfig(episodes, args.seed, temperature, args.end)
    policies = len(fixed_drivers(task_of(bundle), world_of(bundle))) + (driving.controller is not None)
    with progress_bar("survival", 2 * policies * episodes, "episodes") as bar:
        found = measure_survival(bundle, driving.controller, wanted, bar.update)
    if not args.json:
        rows = survival_rows(found)
        print_rows(rows, right=tuple(rows[0])[1:])
        print(survival_text(found, episodes, temperature))
    return {"episodes": episodes, "temperature": temperature, **asdict(found)}


def _measure_likeness(
    args: argparse.Namespace, bundle: Bundle, driving: DriverChoice, config: DisturbedDriveConfig, temperature: float
) -> dict[str, Any]:
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.inspection.measurements import likeness
    from dreamfleet.worker.inspection.road_losses import RoadLossConfig
    from dreamfleet.worker.inspection.tables import LIKENESS, likeness_rows

    drives, wanted = DRIVES if args.episodes is None else args.episodes, RoadLossConfig(temperature=temperature)
    with progress_bar("likeness", drives, "drives") as bar:
        compared = likeness(bundle, driving, config, wanted, drives, bar.update)
    if not args.json:
        rows = likeness_rows(compared)
        print_rows(rows, right=tuple(rows[0])[1:])
        print(LIKENESS)
    facts = {"drives": drives, "dreams": wanted.dreams, "temperature": wanted.temperature}
    return {**facts, "quantities": [asdict(each) for each in compared]}


def _measure_losses(
    args: argparse.Namespace, bundle: Bundle, driving: DriverChoice, config: DisturbedDriveConfig, temperature: float
) -> dict[str, Any]:
    from dreamfleet.common.cli.progress import progress_bar
    from dreamfleet.worker.inspection.measurements import measure_dream_losses
    from dreamfleet.worker.inspection.road_losses import RoadLossConfig
    from dreamfleet.worker.inspection.tables import loss_rows, loss_text

    wanted = RoadLossConfig(LOSSES if args.episodes is None else args.episodes, temperature=temperature)
    with progress_bar("losses", wanted.losses, "losses") as bar:
        compared, drives = measure_dream_losses(bundle, driving, config, wanted, bar.update)
    if not args.json:
        rows = loss_rows(compared)
        print_rows(rows, right=("n", *tuple(rows[0])[3:]))
        print(loss_text(drives, wanted.dreams, config.lasting))
    facts = {"drives": drives, "dreams": wanted.dreams, "temperature": wanted.temperature, "lasting": config.lasting}
    return {**facts, "begun": [asdict(each) for each in compared]}


def _with_driver(args: argparse.Namespace, subject: InspectionSubject) -> InspectionSubject:
    """The subject, with the driver of its page if one is given."""
    if not args.controller:
        return subject
    bundle, driving = _choose_driver(args, subject)
    controller, own = driving.controller, driving.own
    if controller is None or own is None:
        raise UsageError(f"controller {args.controller} sees no world model: give one that was evolved with one")
    if controller.bundle == bundle.sha256:
        return replace(subject, bundle=bundle.for_controller(controller), controller=controller)
    return replace(subject, bundle=bundle, controller=controller, own=own.for_controller(controller))


def _check_figure_flags(args: argparse.Namespace) -> None:
    fewest, what = (FEWEST_LOSSES, "losses, for --losses") if args.losses else (FEWEST_DRIVES, "drives")
    if args.episodes is not None and args.episodes < fewest:
        raise UsageError(f"--episodes must be at least {fewest} {what}, not {args.episodes}")
    if args.seed < 0 or not 0 <= args.noise <= 10:
        raise UsageError("--seed must be at least 0, --noise from 0 to 10")
    if args.driver and args.survival:
        raise UsageError("--survival measures all drivers: omit --driver")
    if args.controller and args.driver:
        raise UsageError("only one can drive: give --controller or --driver")


def _open_measured_subject(args: argparse.Namespace, held: ExitStack) -> InspectionSubject:
    subject = _open_subject(args, held)
    if args.subject and subject.bundle is None:
        raise UsageError(f"run {args.subject} has no world model to measure: name a bundle, or a run with one")
    return subject


def _open_subject(args: argparse.Namespace, held: ExitStack) -> InspectionSubject:
    from dreamfleet.worker.inspection.page_builder import InspectionSubject, find_subject

    return held.enter_context(find_subject(args.subject, args.runs_dir)) if args.subject else InspectionSubject(None)


def _temperature(args: argparse.Namespace, subject: InspectionSubject) -> float:
    from dreamfleet.worker.dream.batch import DEFAULT_TEMPERATURE

    if args.temperature is not None:
        return float(args.temperature)
    return (subject.run.spec.temperature if subject.run else 0.0) or DEFAULT_TEMPERATURE


def _choose_driver(args: argparse.Namespace, subject: InspectionSubject) -> tuple[Bundle, DriverChoice]:
    """What is measured, and its driver."""
    from dreamfleet.common.runs.lookup import find_bundle_of, find_controller
    from dreamfleet.worker.inspection.measurements import DriverChoice

    controller, own = subject.controller, subject.bundle
    if args.controller:
        controller, beside = find_controller(args.controller, args.runs_dir)
        if own is None or controller.bundle != own.sha256:
            own = find_bundle_of(controller, None, beside)
    bundle = subject.bundle or own
    if bundle is None:
        raise UsageError("give a bundle or a run to measure, or a --controller that has a world model")
    if args.driver:
        return bundle, DriverChoice(driver=args.driver)
    if controller is None and (args.probe or args.losses or args.likeness or not args.survival):
        raise UsageError("name who drives: --controller, or for --probe a --driver")
    return bundle, DriverChoice(controller, own)
