"""A run's status as tables for a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

STATE_STYLES = {
    "running": "green",
    "evaluating": "cyan",
    "paused": "bold red",
    "ended": "bold",
    "waiting for workers": "yellow",
}
SPARKS = "▁▂▃▄▅▆▇█"
SPARK_WIDTH = 60


def run_panel(
    status: dict[str, Any], workers: Sequence[dict[str, Any]], history: Sequence[dict[str, Any]]
) -> RenderableType:
    """The whole picture: state, generation, fitness, fleet."""
    state = status["state"]
    title = f"[bold]{status['run']}[/] · [{STATE_STYLES.get(state, '')}]{state}[/]"
    parts: list[RenderableType] = [_facts(status)]
    if status["why"]:
        parts.append(Text(status["why"], style="bold red" if state == "paused" else ""))
    elif status["failures"]:
        parts.append(Text(_failure(status["failures"][0]), style="red"))
    parts.append(_progress(status))
    if history:
        parts.append(Text.assemble(("mean fitness by generation  ", "dim"), _sparkline(history)))
    parts.append(_worker_table(workers))
    return Panel(Group(*parts), title=title, title_align="left", padding=(0, 1))


def _facts(status: dict[str, Any]) -> Table:
    settings, task = status["settings"], status["settings"]["task"]
    last, best, evaluation = status["last"], status["best"], status["evaluation"]
    waste = status["waste"]
    grid = Table.grid(padding=(0, 3, 0, 1))
    grid.add_column(style="dim")
    grid.add_column()
    grid.add_column(style="dim")
    grid.add_column()
    temperature = status["generation"].get("temperature")  # which an older coordinator does not tell
    warm = "" if temperature is None else f", temperature {temperature:g}"
    grid.add_row(
        "task", f"{task['task']}, {task['horizon']} steps{warm}", "population",
        f"{settings['population']} x {settings['episodes']}",
    )  # fmt: skip
    grid.add_row(
        "last generation", _spread(last) if last else "-",
        "step size", f"{status['generation']['sigma']:.4f} ({_optimiser(settings)})",
    )  # fmt: skip
    grid.add_row("evaluated mean", _evaluated(evaluation), "best", _evaluated(best))
    steps, rate = status["throughput"]["environment_steps"], status["throughput"]["steps_per_second"]
    grid.add_row(
        "throughput", f"{rate:,.0f} steps/s, {steps:,} in all",
        "waste", f"{waste['share']:.1%}, {waste['reissued']} jobs issued again",
    )  # fmt: skip
    dropped = sum(status["dropped"].values())
    if dropped:
        grid.add_row("dropped messages", ", ".join(f"{count} {why}" for why, count in status["dropped"].items()))
    return grid


def _optimiser(settings: dict[str, Any]) -> str:
    name = settings.get("optimiser", "cma")  # which an older coordinator does not tell
    return str(settings["covariance"] if name == "cma" else name)


def _spread(last: dict[str, Any]) -> str:
    return f"{last['mean']:.1f} ± {last['std']:.1f}  ({last['worst']:.0f} to {last['best']:.0f})"


def _evaluated(each: dict[str, Any] | None) -> str:
    if each is None:
        return "-"
    return f"{each['mean']:.1f} ± {each['std']:.1f} on {each['episodes']} tracks (generation {each['generation']})"


def _failure(failure: dict[str, Any]) -> str:
    worker, error = next(iter(failure["errors"].items()))
    return f"candidate {failure['candidate']} failed on {worker}: {error}; another worker will try"


def _progress(status: dict[str, Any]) -> Table:
    generation, evaluating = status["generation"], status["evaluating"]
    collecting = status.get("collecting", {"episodes": 0})  # which an older coordinator does not tell
    grid = Table.grid(padding=(0, 2, 0, 1))
    parts = {f"generation {generation['number']}": generation, "evaluation": evaluating, "kept drives": collecting}
    for label, part in parts.items():
        if part["episodes"] and not (part is generation and status["state"] in ("ended", "evaluating")):
            done, wanted = part["episodes_done"], part["episodes"]
            grid.add_row(label, ProgressBar(wanted, done, width=40), f"{done}/{wanted} episodes")
    return grid


def _sparkline(history: Sequence[dict[str, Any]]) -> Text:
    means = [each["mean"] for each in history][-SPARK_WIDTH:]
    low, high = min(means), max(means)
    scale = (len(SPARKS) - 1) / (high - low) if high > low else 0.0
    bars = "".join(SPARKS[round((mean - low) * scale)] for mean in means)
    return Text.assemble(f"{low:.0f} ", (bars, "green"), f" {high:.0f}")


def _worker_table(workers: Sequence[dict[str, Any]]) -> RenderableType:
    if not workers:
        return Text("no workers yet: start one with  dreamfleet worker --connect tcp/HOST:PORT", style="yellow")
    table = Table(box=None, padding=(0, 2), header_style="dim")
    for column in ("worker", "state", "slots", "leases", "finished", "steps/s", "load", "picture"):
        table.add_column(column, justify="left" if column in ("worker", "state", "picture") else "right")
    for each in workers[:20]:
        style = "" if each["state"] == "present" else "red"
        values = (each["slots"], each["leases"], each["finished"], f"{each['steps_per_second']:.0f}", each["load"],
                  each["drawn_by"])  # fmt: skip
        table.add_row(each["worker"], each["state"], *map(str, values), style=style)
    if len(workers) > 20:
        table.add_row(f"and {len(workers) - 20} more")
    return table
