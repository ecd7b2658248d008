"""What an iteration reached: one line per phase, one row per round."""

from collections.abc import Mapping
from typing import Any

from dreamfleet.common.printable import format_duration, plural
from dreamfleet.common.runs.standard_error import format_with_error
from dreamfleet.experiments.iteration.gate import KNOWS, LOSES, SURVIVES
from dreamfleet.experiments.iteration.layout import IterationFolder
from dreamfleet.experiments.iteration.ledger import FinishedPhase, IterationLedger
from dreamfleet.experiments.iteration.plan import BUNDLE, DATA, EVOLVE, GATE, INIT, MDNRNN, VAE

SHOWN = {  # figures of training, as `train` names them
    VAE: ("reconstruction_error", "active_latents"),
    MDNRNN: ("nats_per_dimension", "reward_auc", "reward_rmse"),
}


def format_entry(entry: FinishedPhase) -> str:
    """A finished phase: its round, what, how long, and what came out."""
    lasted = format_duration(entry.seconds)
    return f"round {entry.round}  {entry.phase:<7} {lasted:>10}  {describe_outcome(entry)}".rstrip()


def describe_outcome(entry: FinishedPhase) -> str:
    """What came out of a phase, in a few words."""
    figures = entry.figures
    if entry.phase in DATA:
        return f"{plural(figures['new'], 'drive')}, {figures['episodes']} in all"
    if entry.phase == INIT:
        return f"{figures['controller']}, of {figures['sha256'][:12]}"
    if entry.phase in SHOWN:
        return ", ".join(f"{name} {figures[name]}" for name in SHOWN[entry.phase] if name in figures)
    if entry.phase == BUNDLE:
        return f"{figures['sha256'][:12]}, of {plural(figures['frames'], 'frame')}"
    if entry.phase == GATE:
        return str(figures["why"])
    if entry.phase == EVOLVE:
        done, ended = plural(figures["generations"], "generation"), figures["ended"]
        return f"{done if ended == done else f'{done}, ended after {ended}'}; {format_score(figures['score'])}"
    return ""


def format_score(score: Mapping[str, Any] | None) -> str:
    """A run's best mean in reality."""
    if score is None:
        return "not evaluated"
    provisional = "" if score["confirmed"] else ", provisional"
    episodes = plural(score["episodes"], score["word"])
    return f"{format_with_error(score['mean'], score['error'])} on {episodes}{provisional}"


def describe_rounds(layout: IterationFolder, ledger: IterationLedger) -> list[dict[str, Any]]:
    """One row per round that was begun, for JSON; round 0 has none."""
    return [_round(layout, ledger, number) for number in sorted({each.round for each in ledger.entries if each.round})]


def table_rows(rounds: list[dict[str, Any]]) -> list[dict[str, object]]:
    """The same rows for people: drives, the model's figures, the gate, the best mean in reality."""
    return [
        {
            "round": each["round"], "drives": each["drives"], "frames": each["frames"],
            "nats": each["quality"].get("nats_per_dimension"), "reward AUC": each["quality"].get("reward_auc"),
            KNOWS: _figure(each["gate"], KNOWS), LOSES: _figure(each["gate"], LOSES), **_survival(each["gate"]),
            "model": _model_state(each), "score": each["score"] and format_score(each["score"]),
        }
        for each in rounds
    ]  # fmt: skip


def best_round(rounds: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The round whose mean scored best; of equals the first. `None`: none was evaluated."""
    scored = [each for each in rounds if each["score"] is not None]
    return max(scored, key=lambda each: each["score"]["mean"], default=None)


def _round(layout: IterationFolder, ledger: IterationLedger, number: int) -> dict[str, Any]:
    entries = (ledger.entry(number, phase) for phase in (BUNDLE, GATE, EVOLVE))
    bundle, gate, run = (entry.figures if entry else {} for entry in entries)
    data = [each.figures["episodes"] for each in ledger.entries if each.round <= number and each.phase in DATA]
    return {
        "round": number, "drives": data[-1] if data else 0, "frames": bundle.get("frames"),
        "quality": bundle.get("quality", {}), "bundle": str(layout.bundle(number)) if bundle else None,
        "sha256": bundle.get("sha256"), "gate": gate or None, "score": run.get("score"),
        "evolved_in": ledger.model_round(number) if run else None,
        "controller": str(layout.optimum(number)) if run else None,
    }  # fmt: skip


def _figure(gate: Mapping[str, Any] | None, name: str) -> str | None:
    found = gate and gate["new"].get(name)
    return format_with_error(found["value"], found["error"], 2) if found else None


def _survival(gate: Mapping[str, Any] | None) -> dict[str, object]:
    return {SURVIVES: _figure(gate, SURVIVES)} if gate and SURVIVES in gate["new"] else {}


def _model_state(row: Mapping[str, Any]) -> str | None:
    """Whether a round's model was kept; None while it is missing or not judged yet."""
    if row["gate"] is not None:
        return "kept" if row["gate"]["kept"] else "refused"
    return "kept" if row["evolved_in"] == row["round"] else None
