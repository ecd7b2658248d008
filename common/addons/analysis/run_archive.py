"""A run's archive as its journal holds it, for people: elites by cell, in words, as tables and as a grid.

Pages: dashboard.md.
"""

import math
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.client.elite_archive import Elite, EliteArchive
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import format_number
from dreamfleet.common.protocol.measures import INFO, STEPS, TRUTH, Axis
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.run_folder import RunFolder, open_run

EXPLORERS = ("cma-me", "map-elites")  # as pyproject.toml names them: candidates seek new cells, and not a better mean
NEAREST = 5  # filled cells that the error for an empty one names


def exploration_note(settings: RunSettings) -> str:
    """What a reader of the fitness curve must know of a search that fills an archive; empty for any other one."""
    if settings.optimiser not in EXPLORERS:
        return ""
    return "Candidates explore: their fitness need not rise. The archive keeps the best one of each cell."


class RunArchive(EliteArchive):
    """The archive of a run's journal."""

    @classmethod
    def of(cls, run: RunFolder) -> Self | None:
        """The archive of a run's closed generations; `None` if the run measures nothing beside fitness.

        Of equal candidates the first one stays.
        """
        found = cls.empty(run.settings)
        if found is None:
            return None
        found.read(run)
        return cls(found.axes, dict(sorted(found.elites.items())))

    @classmethod
    def needed(cls, run: RunFolder) -> Self:
        """The same; `UsageError` for a run without one."""
        if (found := cls.of(run)) is None:
            raise UsageError(f"run {run.name} has no archive: begin one with --archive")
        return found

    def read(self, run: RunFolder, since: int = 0) -> None:
        """Add the candidates of the run's closed generations from `since` on."""
        for candidate in run.measured_candidates(since):
            self.add(*candidate)

    @property
    def facts(self) -> dict[str, Any]:
        """The archive as a plain dictionary."""
        best, axes = self.best, [vars(axis) for axis in self.axes]
        own = best and {**vars(best), "cell": list(best.cell), "measures": list(best.measures)}
        return {"axes": axes, "cells": self.cells, "filled": len(self.elites), "qd_score": self.qd_score, "best": own}

    @property
    def description(self) -> str:
        """Cells filled, QD score and the best elite with its measures, in words."""
        found, best = self.status.description, self.best
        return found if best is None else f"{found}: {self.describe_measures(best)}"

    def describe_elite(self, elite: Elite) -> str:
        """An elite's cell, its measures and its fitness, in words."""
        where = f"cell {','.join(map(str, elite.cell))}: {self.describe_measures(elite)}"
        return f"{where}, fitness {format_number(elite.fitness)} (candidate {elite.generation}/{elite.candidate})"

    def describe_measures(self, elite: Elite) -> str:
        """An elite's measures by name."""
        return ", ".join(
            f"{axis.measure} {format_number(value)}" for axis, value in zip(self.axes, elite.measures, strict=True)
        )

    @property
    def shown_axes(self) -> tuple[Axis, ...]:
        """The two axes of a picture; the second one may have a single cell."""
        return (*self.axes, Axis("", 0, 1, 1))[:2]

    @property
    def shown(self) -> dict[tuple[int, ...], Elite]:
        """The elite that each cell of a picture shows: the best one over the other axes, of equals the first."""
        found: dict[tuple[int, ...], Elite] = {}
        for elite in self.elites.values():
            best = found.setdefault((*elite.cell, 0)[:2], elite)
            if elite.fitness > best.fitness:
                found[(*elite.cell, 0)[:2]] = elite
        return found

    def grid(self) -> NDArray[np.float64]:
        """The fitness by cell of the first axis, and of the second if there is one: `(cells, cells)`; NaN if empty.

        Over further axes it is that of the best elite.
        """
        fitness = np.full([axis.cells for axis in self.shown_axes], np.nan)
        for place, elite in self.shown.items():
            fitness[place] = elite.fitness
        return fitness

    def find(self, text: str) -> Elite:
        """The elite of the cell `3,7`, or of the one that holds `steps=120,brake.share=0.1`; `UsageError` if empty."""
        cell = self._parse(text)
        if (found := self.elites.get(cell)) is not None:
            return found
        filled = sorted(self.elites, key=lambda each: math.dist(each, cell))[:NEAREST]
        nearest = " or ".join(",".join(map(str, each)) for each in filled)
        raise UsageError(
            f"--cell {text}: this cell is empty; {f'filled ones near it are {nearest}' if nearest else 'so are all'}"
        )

    def _parse(self, text: str) -> tuple[int, ...]:
        names = [axis.measure for axis in self.axes]
        parts = text.split(",")
        try:
            if "=" not in text:
                cell = tuple(map(int, parts))
            else:
                values = dict(part.split("=") for part in parts)
                if sorted(values) != sorted(names):
                    raise ValueError
                cell = tuple(axis.cell_of(float(values[axis.measure])) for axis in self.axes)
            if len(cell) != len(names) or not all(0 <= place < axis.cells for place, axis in zip(cell, self.axes)):  # noqa: B905
                raise ValueError
        except ValueError:
            numbers = ",".join(f"0-{axis.cells - 1}" for axis in self.axes)
            example = ",".join(f"{axis.measure}={axis.low:g}" for axis in self.axes)
            raise UsageError(f"--cell takes the cell's numbers ({numbers}) or {example}, not {text!r}") from None
        return cell


def controller_of(run: RunFolder, elite: Elite) -> Controller:
    """An elite as a controller, with where it comes from."""
    provenance = {"run_uid": run.uid, "generation": elite.generation, "candidate": elite.candidate}
    return run.settings.controller_of(run.candidate(elite.generation, elite.candidate), provenance)


def find_elite(runs_dir: Path, name: str, cell: str) -> tuple[Controller, Path, str]:
    """The elite of a run's cell, the path of the run's bundle, and the elite in words.

    `UsageError` for a run without an archive.
    """
    with open_run(runs_dir, name) as run, run.verified_transaction():
        archive = RunArchive.needed(run)
        elite = archive.find(cell)
        return controller_of(run, elite), run.bundle_path, archive.describe_elite(elite)


def tables(archive: RunArchive) -> tuple[list[str], list[dict[str, Any]]]:
    """The elites as a table: its columns, and a row for each."""
    names = [axis.measure for axis in archive.axes]
    cells = [f"cell.{name}" for name in names]
    rows = [
        {**dict(zip(cells, elite.cell, strict=True)), **dict(zip(names, elite.measures, strict=True)),
         "fitness": elite.fitness, "generation": elite.generation, "candidate": elite.candidate}
        for elite in archive.elites.values()
    ]  # fmt: skip
    return [*cells, *names, "fitness", "generation", "candidate"], rows


def describe_measure(name: str) -> str:
    """A measure's name with what it is and its unit, for the axis of a picture.

    >>> describe_measure("brake.share")
    'brake.share (share of the steps in which it is above 0, from 0 to 1)'
    """
    if name == STEPS:
        return "steps (length of the episode, in steps)"
    if name.startswith(INFO):
        return f"{name} (of the last step, in the environment's unit)"
    if name.startswith(TRUTH):
        return f"{name} (mean over the steps, in the task's unit)"
    action, _, kind = name.partition(".")
    means = {
        "": "mean over the steps, or a numbered action's share",
        "abs": "mean magnitude over the steps, in the action's unit",
        "share": "share of the steps in which it is above 0, from 0 to 1",
    }
    return f"{action}{'.' if kind else ''}{kind} ({means.get(kind, 'mean')})"
