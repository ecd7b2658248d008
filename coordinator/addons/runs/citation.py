"""A run's provenance as a citation for papers and reports, with the commands that reproduce it."""

import re
import shlex
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict
from importlib.metadata import metadata
from typing import Any

from dreamfleet.common.addons.markdown import as_code, as_text, fence_of
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.errors import BundleError
from dreamfleet.common.printable import format_duration, one_line, plural
from dreamfleet.common.protocol.tasks import module_of
from dreamfleet.common.runs.lookup import load_controller_of
from dreamfleet.common.runs.records import SUBMITTED, RunSettings
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.run_paths import trust_flag
from dreamfleet.common.runs.run_provenance import RunProvenance, read_run_provenance, read_run_settings
from dreamfleet.common.runs.seeds import TRAINING_FIRST
from dreamfleet.common.runs.stages import begun_stages
from dreamfleet.common.schema.times import parse_time
from dreamfleet.common.schema.validation import to_plain
from dreamfleet.coordinator.addons.runs.run_details import count_failed, describe_failed, describe_stages, view_of

AUTHORS = "The dreamfleet authors"  # as in CITATION.cff


def citation_facts(run: RunFolder) -> dict[str, Any]:
    """The run and its provenance as JSON values; `ControllerError` before the run has a controller."""
    controller = load_controller_of(run)
    receipt, settings = read_run_provenance(controller), read_run_settings(controller)
    view, spent, history = view_of(run), run.total_effort(), run.history()
    return {
        "run": run.name, "run_uid": run.uid, "created": run.created, "ended": run.ended,
        "ended_at": run.ended_at, "lasted_seconds": run.duration_seconds,
        "controller": controller.sha256, "generation": controller.provenance.get("generation"),
        "bundle": settings.task.bundle or None,
        "score": view.score, "failed_episodes": view.reported.failed if view.reported else 0,
        "failed_candidates": count_failed(history), "replaced_seeds": run.count_reseeds(history),
        "on_failure": settings.on_failure,
        "spent": {**asdict(spent), "core_hours": spent.core_hours},
        "settings": to_plain(settings), "receipt": to_plain(receipt), "commands": _commands(run),
        "bit_identical": {"candidate": not run.classes.varying, "run": not (run.classes.mixed or run.classes.varying)},
        "software": software_facts(receipt),
    }  # fmt: skip


def software_facts(receipt: RunProvenance) -> dict[str, str]:
    """The software as a paper cites it: of the version that served the run; `url` where the distribution names one."""
    about = metadata("dreamfleet")
    facts = {"title": about["Name"], "authors": AUTHORS, "version": (receipt.versions or {}).get("dreamfleet", "")}
    pages = [each.partition(", ")[2] for each in about.get_all("Project-URL") or ()]
    return facts | ({"url": pages[0]} if pages else {})


def format_markdown(run: RunFolder) -> str:
    """The same as Markdown: a list, the commands, and BibTeX entries of the run and the software."""
    controller = load_controller_of(run)
    receipt, settings = read_run_provenance(controller), read_run_settings(controller)
    rows = [f"- {as_text(name)}: {value}" for name, value in _rows(run, controller, receipt, settings)]
    commands = [f"{command}   # {why}" for why, command in _commands(run).items()]
    entries = _bibtex(run, controller, receipt)
    fence = fence_of("\n".join([*commands, *entries]))
    blocks = [f"{fence}sh", *commands, fence, "", f"{fence}bibtex", *entries, fence]
    return "\n".join([f"# Run {as_text(run.name)}", "", *rows, "", *blocks])


def _rows(
    run: RunFolder, controller: Controller, receipt: RunProvenance, settings: RunSettings
) -> Iterator[tuple[str, str]]:
    """Names as text and values as Markdown: what a file says is quoted, since others may have written it."""
    spec, view = settings.task, view_of(run)
    lasted = run.duration_seconds
    at = "" if lasted is None else f" at {run.ended_at}, {format_duration(lasted)} after it began"
    since, state = run.created or "at an unknown time", f"ended after {run.ended}{at}" if run.ended else "open"
    yield "run", f"{as_code(run.uid)}, {as_text(f'begun {since}, {state}')}"
    history, written = run.history(), controller.provenance.get("generation")
    lags = view.reported is None and history and written != history[-1].number  # a mean that is in no journal
    after = f", the mean of generation {written}: that of {history[-1].number} is not written yet" if lags else ""
    yield "controller", f"SHA-256 `{controller.sha256}` of its parameters{as_text(after)}"
    yield "world model", f"SHA-256 {as_code(spec.bundle)}" if spec.bundle else "none"
    yield "score", as_text(view.score)
    warm = "" if spec.temperature is None else f", temperature {spec.temperature:g}"
    warm += f", end {spec.end}" if spec.end else ""
    generations = plural(len(history), "generation")
    if settings.stages:  # each has a horizon, a population and more of its own
        begun = begun_stages(settings, history, run.evaluations())
        yield "task", as_code(spec.task) + as_text(f"{warm}, version {spec.version}")
        yield "search", as_text(f"{settings.optimiser}, {settings.covariance}, {generations}")
        yield from ((name, as_text(text)) for name, text in describe_stages(settings, begun).items())
    else:
        yield "task", as_code(spec.task) + as_text(f", {view.steps}{warm}, version {spec.version}")
        size = f"population {settings.population} x {plural(settings.episodes, 'episode')}"
        size += f"{', racing' if settings.racing else ''}, sigma0 {settings.sigma0:g}"
        own = f"{settings.optimiser}, {settings.covariance}, {size}, {generations}"
        yield "search", as_text(f"{SUBMITTED}, {generations}" if settings.is_external else own)
    yield "failed candidates", as_text(describe_failed(settings, history, run.count_reseeds(history)))
    so_far = "" if run.ended else "; so far, with the results of the open generation"
    yield "spent", as_text(f"{run.total_effort().describe(run.spec.task)}{so_far}")
    yield "seed", f"{settings.seed}; training seeds follow from it, from {TRAINING_FIRST} up"
    for what, (first, count) in (receipt.seeds or {}).items():
        yield f"seeds of the {what}", f"{first} to {first + count - 1}"
    if receipt.start is not None:
        yield "begun at", f"{as_text(receipt.start.source)}, SHA-256 {as_code(receipt.start.sha256)}"
    if settings.subspace:
        yield "subspace", f"SHA-256 {as_code(settings.subspace)}"
    if receipt.classes is not None:
        yield "hosts", as_text(receipt.classes.description)
        yield from ((f"class {name}", as_text(hosts)) for name, hosts in receipt.classes.rows)
    elif receipt.fingerprint is not None:
        others = ", and others: no run on one host is bit-identical" if receipt.mixed else ""
        yield "hosts", f"{as_code(receipt.fingerprint)}{others}"
    if receipt.checks is not None:
        yield "checked on other hosts", as_text(receipt.checks.description)
    if receipt.versions is not None:
        yield "coordinator", as_text(", ".join(f"{name} {version}" for name, version in receipt.versions.items()))


def _commands(run: RunFolder) -> dict[str, str]:
    """Commands that check the run, keyed by what they show."""
    last, classes = max((each.number for each in run.history()), default=0), run.classes
    beside = ("--runs-dir", str(run.path.parent))
    first = ("--candidate", f"{last}/0")
    one, whole = "bit-identical on any host of its class", "bit-identical"
    if classes.mixed:
        whole = "not bit-identical: hosts of several classes scored"
    if classes.varying:
        one = whole = "not bit-identical: the environment is not deterministic"
    modules = _task_modules(run)
    trust, trust_all = trust_flag(modules), trust_flag([*modules, module_of(run.settings.optimiser)])
    words = {
        f"one candidate's fitness again, {one}": ("verify", "candidate", run.name, *first, *beside, *trust),
        f"the whole run again, {whole}": ("verify", "run", run.name, *beside, *trust_all),
        "its score on unseen seeds": ("evaluate", "--controller", str(run.path), "--episodes", "100", *trust),
    }
    return {why: shlex.join(("dreamfleet", *each)) for why, each in words.items()}


def _task_modules(run: RunFolder) -> list[str]:
    """The modules of the run's task and of its world model's task, which its commands import."""
    tasks = [run.spec.task]
    with suppress(BundleError):  # then the commands say what is wrong with it
        tasks += [Bundle.open(run.bundle_path, run.spec.bundle).manifest.task] if run.spec.bundle else []
    return [module_of(each) for each in tasks]


def _bibtex(run: RunFolder, controller: Controller, receipt: RunProvenance) -> list[str]:
    version, begun = _field((receipt.versions or {}).get("dreamfleet", "")), parse_time(run.created)
    about = f"run {_field(run.uid)}, controller SHA-256 {controller.sha256}"
    return [
        f"@misc{{dreamfleet-{run.name},",
        f"  title = {{Run {run.name} of dreamfleet {version}}},",
        *([] if begun is None else [f"  year = {{{begun.year}}},"]),
        f"  note = {{{about}, {plural(len(run.history()), 'generation')}}}",
        "}",
        "@misc{dreamfleet,",
        ",\n".join(f"  {name} = {{{text}}}" for name, text in _software_fields(receipt) if text),
        "}",
    ]


def _software_fields(receipt: RunProvenance) -> Iterator[tuple[str, str]]:
    """The software's BibTeX fields. Without braces of its own, `authors` would be the authors' family name."""
    for name, text in ((name, _field(text)) for name, text in software_facts(receipt).items()):
        yield ("author", f"{{{text}}}") if name == "authors" else (name, text)


def _field(text: str) -> str:
    """A text as a BibTeX field on one line, which nothing in it ends."""
    return re.sub(r"[{}\\]", "", one_line(text))
