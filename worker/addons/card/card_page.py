"""The page of a published controller: a model card in Markdown, under the metadata that model hubs read."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dreamfleet.common.addons.evaluation_report import REPORT, EvaluationReport
from dreamfleet.common.addons.markdown import as_code, as_text
from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import IMPORTED, Controller
from dreamfleet.common.host.packages import package_version
from dreamfleet.common.printable import one_line, plural
from dreamfleet.common.protocol.tasks import GYM
from dreamfleet.common.runs.episode_results import EpisodeResult
from dreamfleet.common.runs.seeds import TEST
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.common.worlds.score_words import profile_of, score_word
from dreamfleet.worker.addons.evaluation.known_score import find_known_score

PAGE, CONTROLLER, BUNDLE = "README.md", "controller.npz", "bundle.zip"
DRIVER, SCRIPT, SCORES = "controller.onnx", "drive.py", "scores.png"
VIDEO = "replay.mp4"  # the name under which model hubs look for it
WHAT = {
    CONTROLLER: "parameters, shape, task and provenance",
    BUNDLE: "the world model: encoder, decoder, and the MDN-RNN that dreams",
    DRIVER: "encoder, MDN-RNN and controller as one ONNX graph: `picture` and `state` to `action` and `next_state`",
    SCRIPT: "drives without dreamfleet",
    REPORT: "the score of each seed; `dreamfleet verify report` scores them again",
    SCORES: "these scores, drawn",
    VIDEO: "a drive",
}
NAME_YOURS = "name yours before you publish, such as mit, apache-2.0 or cc-by-4.0"
ORIGINS = {"steps": "run_steps", **{name: name for name in ("run_uid", "generation", IMPORTED, "layout")}}


@dataclass
class CardContents:
    """What a card is of, and what is known of it."""

    controller: Controller
    bundle: Bundle | None
    report: EvaluationReport | None
    name: str
    difference: float | None = None  # of the one graph's actions from dreamfleet's own; `None`: there is no such graph
    filmed: EpisodeResult | None = None  # the drive of the video
    is_cut: bool = False  # whether the video ends before the drive
    install: str = ""  # the command that installs what the script needs
    missing: dict[str, str] = field(default_factory=dict)  # files that it cannot have, and why

    @property
    def world(self) -> str:
        """The task whose world the controller drives in."""
        return self.controller.task if self.bundle is None else self.bundle.manifest.task


def describe_card(contents: CardContents, files: Sequence[str]) -> Iterator[str]:
    """The lines of the page of a folder with these files."""
    yield from _metadata(contents, files)
    yield from ("", f"# {as_text(contents.name)}", "", _describe_controller(contents))
    if VIDEO in files:
        yield from ("", f'<video src="{VIDEO}" controls width="100%"></video>', "", _describe_video(contents))
    yield from ("", "## Scores", "")
    if contents.report is None:
        yield _describe_known_score(contents)
    else:
        yield from (f"- {as_text(each)}" for each in contents.report.describe(score_word(contents.world)).splitlines())
        yield from ("", f"![The score of each seed]({SCORES})")
    yield from ("", "## Use", "")
    if SCRIPT in files:
        yield from _describe_script(contents)
    bundle = f" --bundle {BUNDLE}" if contents.bundle is not None else ""
    yield from ("With dreamfleet:", "", "```sh", "pip install 'dreamfleet[worker,views]'")
    yield from (f"dreamfleet evaluate --controller {CONTROLLER}{bundle} --episodes 100",)
    yield from (f"dreamfleet record --controller {CONTROLLER}{bundle}", "```", "", "## Files", "")
    yield from (f"- [`{each}`]({each}): {WHAT[each]}" for each in files)
    yield from ("", "## Where it comes from", "", "```json")
    yield json.dumps(_origin(contents.controller, contents.bundle), indent=1, sort_keys=True)
    yield from ("```", "", "## Licence", "", "Not named yet: name yours here, and in the second line of this file.")


def _describe_known_score(contents: CardContents) -> str:
    """What is known without a report: of a run's controller its confirmation."""
    if (known := find_known_score(contents.controller)) is None:
        return "Not evaluated."
    mean, word = format_with_error(known.mean, known.error), score_word(contents.world)
    return as_text(f"{mean} (standard error), the mean of {plural(known.episodes, word)}.")


def _metadata(contents: CardContents, files: Sequence[str]) -> Iterator[str]:
    world = contents.world.removeprefix(f"{GYM}:")
    tags = ["reinforcement-learning", "dreamfleet", world, *(["world-models"] if contents.bundle is not None else [])]
    yield from ("---", f"license: other  # {NAME_YOURS}")
    yield from ("library_name: dreamfleet", "pipeline_tag: reinforcement-learning", "tags:")
    yield from (f"- {_quoted(each)}" for each in [*tags, *(["onnx"] if DRIVER in files else [])])
    if contents.report is not None:
        yield from _index(contents.report, world, contents.name)
    yield "---"


def _index(report: EvaluationReport, world: str, name: str) -> Iterator[str]:
    """The result as model hubs index it."""
    found = report.results
    value = f"{found.mean:z.2f}" if found.std is None else f"{found.mean:z.2f} +/- {found.std:.2f}"
    yield from ("model-index:", f"- name: {_quoted(name)}", "  results:", "  - task:")
    yield from ("      type: reinforcement-learning", "      name: reinforcement-learning")
    yield from ("    dataset:", f"      name: {_quoted(world)}", f"      type: {_quoted(world)}", "    metrics:")
    yield from ("    - type: mean_reward", f"      value: {value}", "      name: mean_reward", "      verified: false")


def _describe_controller(contents: CardContents) -> str:
    controller, bundle = contents.controller, contents.bundle
    text = f"A controller of {plural(controller.shape.size, 'parameter')} for {as_code(contents.world)}. "
    if (source := controller.provenance.get(IMPORTED)) is None:
        text += f"The Python package `dreamfleet` evolved it in the task {as_code(controller.task)}."
    else:
        text += f"The Python package `dreamfleet` imported it from another program's file, {as_code(str(source))}."
    if bundle is not None:
        hidden = f" and memory ({bundle.manifest.hidden})" if controller.shape.features > bundle.manifest.latent else ""
        latent = plural(bundle.manifest.latent, "number")
        text += f" It sees a world model's latent ({latent}){hidden}, of the frozen VAE and MDN-RNN in `{BUNDLE}`."
    return text


def _describe_video(contents: CardContents) -> str:
    filmed, world = contents.filmed, contents.world
    assert filmed is not None
    score = as_text(f"{profile_of(world).format_score(filmed.score)} on {score_word(world)} {filmed.seed}")
    if contents.is_cut:
        return f"{score} in its first {plural(filmed.steps, 'step')}."
    if contents.report is None:
        return f"{score}."
    results = contents.report.results
    mean = format_with_error(results.shown(results.mean), results.error)
    return f"{score}: a median drive of {len(results.drives)}, whose mean is {mean}."


def _describe_script(contents: CardContents) -> Iterator[str]:
    seeds = (TEST if contents.report is None else contents.report.results.seeds)[:2]
    yield from ("Without dreamfleet:", "", "```sh", contents.install)
    yield from (f"python {SCRIPT} {' '.join(map(str, seeds))}", "```", "")
    if contents.difference == 0:
        yield "On the host that wrote this card, its actions and dreamfleet's are bit-identical."
    elif contents.difference is not None:
        yield (
            f"Its actions differ from dreamfleet's by about {contents.difference:.1g}: dreamfleet computes such "
            "controllers in NumPy."
        )
    yield ""


def _origin(controller: Controller, bundle: Bundle | None) -> dict[str, Any]:
    facts = controller.provenance
    return {
        "controller_sha256": controller.sha256,
        "bundle_sha256": "" if bundle is None else bundle.sha256,
        "options": controller.options,
        "dreamfleet": package_version("dreamfleet"),
        **{name: facts[key] for key, name in ORIGINS.items() if key in facts},
    }


def _quoted(text: str) -> str:
    """A name as a string of YAML on one line."""
    return json.dumps(one_line(text), ensure_ascii=False)


def read_install_command(script: Path) -> str:
    """The line of a script that says what it needs."""
    return next(line for line in script.read_text().splitlines() if line.startswith("pip install"))
