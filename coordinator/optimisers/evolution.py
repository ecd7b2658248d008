"""A run's optimiser: built from the run's settings, held to its contract, and continued from the journal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from shlex import quote
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.subspace import SearchSpace, Subspace
from dreamfleet.common.errors import DreamfleetError, JournalError, UsageError
from dreamfleet.common.printable import one_line
from dreamfleet.common.protocol.measures import parse_axes
from dreamfleet.common.runs.records import RunSettings
from dreamfleet.common.runs.seeds import search_seed
from dreamfleet.common.runs.stages import Stage
from dreamfleet.coordinator.optimisers.api import Search
from dreamfleet.coordinator.optimisers.checkpoint import PREFIX, Checkpoint, Head
from dreamfleet.coordinator.optimisers.registry import build_optimiser, check_memory


class Evolution:
    """Maximises fitness by the run's optimiser; a checkpoint is taken between an update and the next `ask`.

    >>> evolution = Evolution("cma", Search(mean=np.zeros(3), population=4, sigma0=0.1, seed=1))
    >>> candidates = evolution.ask()
    >>> evolution.tell(np.array([1.0, 2.0, 3.0, 4.0]))
    """

    def __init__(self, optimiser: str, search: Search, space: SearchSpace | None = None) -> None:
        """`search` begins at parameters `(dimension,)`; in a `space` these are the zero of its coordinates."""
        if search.population < 2:
            raise UsageError(f"population must be at least 2, not {search.population}")
        if not 0 < search.sigma0 < float("inf"):
            raise UsageError(f"sigma0 must be a positive number, not {search.sigma0}")
        self._name = optimiser
        self._space = space
        self._origin = np.asarray(search.mean, dtype=np.float64)
        mean = self._origin if space is None else np.zeros(space.dimension)
        self._search = replace(search, mean=mean)
        check_memory(optimiser, self._search.dimension, search.population, search.options)
        self._optimiser = build_optimiser(optimiser, self._search)
        self._is_open = False  # after `ask`, before `tell`

    @classmethod
    def of(
        cls, settings: RunSettings, stage: Stage, subspace: Subspace | None, start: NDArray[np.float64] | None
    ) -> Evolution:
        """As a run's settings say for the search that goes on in this stage, at `start` `(dimension,)` or at zeros.

        `subspace` is the run's.
        """
        # It is a setting of its own, older than options; its default is none, so that every optimiser takes it.
        covariance = () if settings.covariance == "diagonal" else (f"covariance={settings.covariance}",)
        search = Search(
            np.zeros(settings.controller.size) if start is None else start,
            stage.settings.population,
            stage.settings.sigma0,
            search_seed(settings.seed, stage.search),
            parse_options([*settings.optimiser_options, *covariance]),
            parse_axes(settings.archive),
        )
        space = None if subspace is None or stage.all_parameters else SearchSpace(subspace, settings.controller)
        return cls(settings.optimiser, search, space)

    @property
    def mean(self) -> NDArray[np.float64]:
        """The best guess `(dimension,)`."""
        return self._to_parameters(np.array(self._optimiser.mean, dtype=np.float64))

    @property
    def sigma(self) -> float:
        """The overall step size, of a search in a subspace in its coordinates."""
        return float(self._optimiser.sigma)

    @property
    def axis_ratio(self) -> float | None:
        """The longest axis of the distribution by the shortest; `None` where the optimiser does not say."""
        with np.errstate(all="ignore"):
            found = getattr(self._optimiser, "axis_ratio", None)
        return float(found) if isinstance(found, (int, float)) and math.isfinite(found) else None

    def ask(self) -> NDArray[np.float64]:
        """The next population `(population, dimension)`; `DreamfleetError` if the optimiser breaks its contract."""
        self._is_open = True
        return self._check(self._optimiser.ask(), self._search.population)

    def redraw(self, indices: Sequence[int]) -> NDArray[np.float64]:
        """Replace these candidates of the open population; the new ones `(len(indices), dimension)`.

        An optimiser may keep a candidate that it did not draw at random.
        """
        return self._check(cast(Any, self._optimiser).redraw(indices), len(indices))

    def check_redraws(self) -> None:
        """`UsageError` if the optimiser cannot draw single candidates anew."""
        if not callable(getattr(self._optimiser, "redraw", None)):
            raise UsageError(f"optimiser {self._name!r} cannot redraw single candidates: pass --on-failure worst")

    def _check(self, drawn: object, count: int) -> NDArray[np.float64]:
        """The parameters `(count, dimension)` of what the optimiser drew."""
        asked = np.asarray(drawn, dtype=np.float64)
        wanted = count, self._search.dimension
        if asked.shape != wanted:
            raise DreamfleetError(f"optimiser {self._name!r} asked for {asked.shape} numbers, not {wanted}")
        asked = self._to_parameters(asked)
        with np.errstate(over="ignore"):
            travels = np.isfinite(asked.astype(np.float32)).all() and np.isfinite(self.sigma)
        if not travels:
            raise DreamfleetError(
                f"optimiser {self._name!r} asked for what no single-precision number can hold, at "
                f"step size {self.sigma:g}: it cannot continue; start one --from it with other --sigma0 or --optimiser"
            )
        return asked

    def tell(self, fitness: NDArray[np.float64], measures: NDArray[np.float64] | None = None) -> None:
        """Update the distribution; `fitness` `(population,)`, larger is better, in the order of `ask`.

        `measures` `(population, axes)` are of a run with an archive, NaN for a candidate that failed; an optimiser that
        does not take them gets none.
        """
        if fitness.shape != (self._search.population,) or not np.isfinite(fitness).all():
            raise ValueError(f"an update needs {self._search.population} finite numbers")  # pycma accepts NaN silently
        if getattr(self._optimiser, "takes_measures", False):
            cast(Any, self._optimiser).tell(fitness, measures)
        else:
            self._optimiser.tell(fitness)
        self._is_open = False

    def prepare(self) -> None:
        """Do now what the next `ask` would do, as far as it does not depend on `tell`."""
        self._optimiser.prepare()

    def state(self) -> Checkpoint:
        """Everything that the next `ask` depends on."""
        assert not self._is_open, "a state is taken after an update and before ask"
        state = self._optimiser.state()
        unfit = [name for name, array in state.items() if name.startswith(PREFIX) or array.dtype.hasobject]
        if unfit:
            raise DreamfleetError(
                f"optimiser {self._name!r} has a state that cannot be kept, in {', '.join(unfit)}: arrays "
                f"hold numbers or text, and names that begin with {PREFIX!r} are taken"
            )
        origin = None if self._space is None else self._origin
        head = Head(self._name, self._optimiser.requirement, self.mean, self.sigma, origin)
        return Checkpoint(head, state)

    def _read_origin(self, head: Head) -> NDArray[np.float64]:
        """From where a state's coordinates count; `ValueError` if it does not say."""
        origin = None if head.origin is None else np.asarray(head.origin, dtype=np.float64)
        if origin is None or origin.shape != self._origin.shape:
            raise ValueError("the origin of its subspace is not there")
        if not (np.abs(origin) <= np.finfo(np.float32).max).all():  # false for NaN too
            raise ValueError("the origin of its subspace holds what no single-precision number can")
        return origin

    def _to_parameters(self, coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        """The parameters `(..., dimension)` of the optimiser's coordinates."""
        space = self._space
        return coordinates if space is None else space.lift(self._origin, coordinates)

    def restore(self, state: bytes) -> None:
        """Continue from a packed `state` of an equal configuration; `JournalError` if another optimiser wrote it."""
        checkpoint, name, requirement = Checkpoint.unpack(state), self._name, self._optimiser.requirement
        head = checkpoint.head
        if head.name != name:
            raise JournalError(f"this state was written by optimiser {head.name!r}, not by {name!r}")
        if head.requirement != requirement:
            needed = f"pip install {quote(head.requirement)}"
            raise JournalError(f"another version wrote this run: {needed} (now {requirement})")
        try:
            if self._space is not None:
                self._origin = self._read_origin(head)
            self._optimiser.restore(checkpoint.state)
        except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
            why = one_line(f"{type(error).__name__}: {error}")
            raise JournalError(f"the journal's last state is damaged ({why}): restore it from a copy") from error
        self._is_open = False


def parse_options(given: Sequence[str]) -> dict[str, str]:
    """Options from `name=value` each; an empty text is none."""
    options: dict[str, str] = {}
    for text in filter(None, given):
        name, equals, value = text.partition("=")
        if not equals or not name or name in options:
            raise UsageError(f"--optimiser-options takes name=value, each name once, not {text!r}")
        options[name] = value
    return options
