"""What `dreamfleet --help` shows: the verbs by what people do with them, one short line each."""

from collections.abc import Callable, Iterable, Mapping
from textwrap import wrap

WIDTH = 80  # columns
SHOWN = 22  # columns of a verb's name
# Heading: names of verbs as their entry points have them: text. Verbs of a group may share a line.
GROUPS: Mapping[str, Mapping[tuple[str, ...], str]] = {
    "Start here": {
        ("demo",): "evolve a controller on this machine in minutes",
        ("live",): "watch a worker, the best mean or a controller drive",
        ("drive",): "drive yourself, on the track or in a dream",
        ("evaluate",): "score a controller on unseen seeds",
        ("record",): "record a controller's drives as mp4",
        ("compare",): "compare runs or evaluation reports with each other",
        ("doctor",): "check this installation and name what is missing",
        ("completion",): "print a script that completes verbs and flags",
    },
    "A run": {
        ("coordinator",): "start, continue or fork a run: CMA-ES asks",
        ("worker",): "score candidates for a run, on any host",
        ("sweep",): "evolve with several seeds and settings, and compare",
        ("status",): "show a live run: generation, best, workers, time left",
        ("dashboard",): "serve a read-only web page about runs",
        ("serve",): "let a search in any language score batches over HTTP",
        ("story",): "list what happened to a run, its workers and jobs",
        ("pause", "resume"): "hold a run, and go on",
        ("drain", "stop"): "end its coordinator after the open jobs, or now",
        ("bar",): "keep out a host that scores wrongly",
    },
    "Hosts": {
        ("spawn", "down"): "start workers on other hosts over ssh, and end them",
        ("router",): "forward between coordinators and workers",
        ("access.init", "access.issue"): "create a fleet's authority, and join files for TLS",
        ("access.list", "access.revoke"): "list join files, and revoke one",
    },
    "Runs on this disk": {
        ("runs.list", "runs.show"): "list runs; show one: settings, generations, scores",
        ("runs.plot",): "draw what runs learnt",
        ("runs.export",): "write a run as CSV, Parquet or TensorBoard events",
        ("card",): "write a controller as a folder to publish",
        ("runs.receipt",): "print what a paper cites of a run",
        ("runs.backup", "runs.archive"): "copy a run to another disk; put it away",
        ("runs.delete",): "delete a run",
    },
    "Verify what was recorded": {
        ("verify.report",): "score a report's controller again on the same seeds",
        ("verify.candidate",): "score one candidate of a run again, bit by bit",
        ("verify.run",): "evolve a controller's whole run again",
    },
    "World models": {
        ("pipeline",): "make one: drives, VAE, latents, MDN-RNN, bundle",
        ("iterate",): "make world models and evolve in them, in turn",
        ("collect",): "collect drives as training data",
        ("train",): "train the VAE; once drives are encoded, the MDN-RNN",
        ("encode",): "encode the drives with the trained VAE",
        ("bundle",): "freeze a trained model into one file, and back",
        ("import",): "read what another project made",
        ("inspect",): "show what a world model sees, keeps and dreams",
    },
    "Study": {
        ("tasks",): "list the worlds that can be scored; check one",
        ("baseline.train",): "train a network that drives without a world model",
        ("baseline.export",): "write it as one file",
        ("lab.bench",): "measure how fast a part is",
        ("lab.contrast",): "train kinds of MDN-RNNs and compare them",
        ("lab.refit",): "fit a controller to another world model",
        ("lab.subspace",): "find few features that predict a driver's actions",
    },
}
OTHERS = "Of other packages"
USAGE = "usage: dreamfleet VERB ...      `dreamfleet VERB --help` shows its flags"


def overview(description: str, footer: str, names: Iterable[str], summary: Callable[[str], str]) -> str:
    """The help text: all `names` by group; `summary` describes a verb that no group has, which is a plug-in's."""
    left = set(names)
    lines = [USAGE, "", description]
    for heading, entries in GROUPS.items():
        lines += ["", heading]
        for verbs, text in entries.items():
            lines.append(_line(_spoken(verbs), text))
            left -= set(verbs)
    if left:
        lines += ["", OTHERS, *(_line(name.replace(".", " "), summary(name)) for name in sorted(left))]
    return "\n".join((*lines, "", *wrap(footer, WIDTH), ""))


def _spoken(names: tuple[str, ...]) -> str:
    """Verbs as people type them, a group's word once.

    >>> _spoken(("runs.list", "runs.show"))
    'runs list, show'
    """
    group, dot, _ = names[0].partition(".")
    words = ", ".join(name.rpartition(".")[2] for name in names)
    return f"{group} {words}" if dot else words


def _line(shown: str, text: str) -> str:
    return f"  {shown:<{SHOWN}} {text}"
