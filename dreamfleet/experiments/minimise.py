"""Searching the minimum or maximum of a Python function on a fleet, with restarts: each search is a run.

Pages: own-objective.md.
"""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.objective import Objective
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import format_number, plural
from dreamfleet.common.protocol.stop_kind import StopKind, StopReason
from dreamfleet.common.runs.records import StoredGeneration
from dreamfleet.common.runs.run_paths import default_runs_dir, run_command
from dreamfleet.common.schema.display import Displayed
from dreamfleet.experiments.local.function_names import is_noisy, name_function
from dreamfleet.experiments.local.local_run import has_begun
from dreamfleet.experiments.local.search_arguments import (
    check_names,
    generations_within,
    limits_within,
    read_objective,
    read_seed,
)
from dreamfleet.experiments.started_run import RunPausedError, StartedRun, start_run_in

Floats = NDArray[np.float64]
Restart = Literal["ipop", "bipop"]
SHOWN = 6  # parameters in one line
MOST = 2**53  # of calls and candidates
FULL_DIMENSION = 200  # up to which CMA-ES learns the full matrix by default
DETERMINISTIC = {"episodes": 1, "evaluate_every": 10, "evaluation_episodes": 1, "confirm_episodes": 0}
NOISY = {"episodes": 2, "evaluate_every": 10, "evaluation_episodes": 20, "confirm_episodes": 20}
CALLER = 4  # frames from `_Searches._run` to the program that searches
CONVERGED = (StopKind.STAGNATION, StopKind.ONE_POINT)


class Progress(NamedTuple):
    """Where a search stands as a generation closes; values have the function's sign."""

    run: str
    generation: int
    nfev: int  # calls for candidates so far, those of earlier restarts included
    x: Floats  # the best candidate so far `(dimension,)`
    fun: float  # its value
    mean: float  # of the generation's values
    sigma: float  # the step size, in steps of sigma0


@dataclass(frozen=True, repr=False)
class SearchResult(Displayed):
    """What `minimise` and `maximise` return, with the names of `scipy.optimize` and pycma.

    Without noise `x` is the better one of `xbest` and `xfavorite`. For a function with a seed it is `xfavorite`,
    because the best value of a candidate was lucky too. `success` says whether `ftarget` was reached, or without one
    whether the search converged.

    >>> import numpy as np
    >>> SearchResult(np.ones(2), 0.5, 120, 20, "converged", True, (), ("mine",), np.ones(2), np.zeros(2))
    <SearchResult: 0.5 at [1.0, 1.0] after 120 evaluations, converged>
    """

    x: Floats  # (dimension,)
    fun: float  # its value; of a noisy function an estimate
    nfev: int  # calls whose values counted, of candidates and means, an open generation's included
    nit: int  # generations
    message: str  # why it ended
    success: bool
    history: tuple[Progress, ...]
    runs: tuple[str, ...]  # the name of each restart's run
    xbest: Floats  # the best candidate of all
    xfavorite: Floats  # the best evaluated mean of the search that found `x`

    @property
    def run(self) -> str:
        """The name of the last run; `dreamfleet.open_run` and all verbs read it."""
        return self.runs[-1]

    def _display(self) -> tuple[str, dict[str, object]]:
        numbers = ", ".join(map(format_number, self.x[:SHOWN].tolist())) + (", ..." if len(self.x) > SHOWN else "")
        value, calls = format_number(self.fun), plural(self.nfev, "evaluation")
        headline = f"SearchResult: {value} at [{numbers}] after {calls}, {self.message}"
        return headline, {"x": self.x, "success": self.success, "runs": ", ".join(self.runs)}


Callback = Callable[[Progress], object]


def minimise(
    function: Callable[..., Any] | str, x0: Sequence[float] | Floats, sigma0: float | Sequence[float] | None = None, *,
    bounds: Any = None, integer: Sequence[int] | bool = (), log: Sequence[int] | bool = (),
    ftarget: float | None = None, maxfevals: int | None = None, popsize: int | None = None, restarts: int = 0,
    restart: Restart = "ipop", penalty: float | None = None, callback: Callback | None = None,
    workers: int | None = None, run: str | None = None, runs_dir: Path | str | None = None, **settings: Any,
) -> SearchResult:  # fmt: skip
    """Search a minimum of `function(x)` from `x0`, with steps of about `sigma0`, on processes of this host.

    `function` is a function of a module, as its name travels: `x` is float64 `(dimension,)`, and it returns a number.
    If it has a second parameter `seed`, it is noisy: each candidate is called with 2 seeds (`episodes`), and every
    tenth generation's mean with 20. `fun` is then such a mean's confirmed score, an estimate.

    `bounds` is a pair for each parameter, or one for all, with `None` for no bound. Parameters in `integer` are
    rounded, so that `int(x[i])` is exact; those in `log` are searched by their logarithm: there a step of 1 is a factor
    of 2.7. `sigma0` may be a list; without one it is 0.3 of each parameter's range. `penalty` replaces NaN and
    infinity, which otherwise count as failed candidates. The first one of a search is a `RuntimeWarning`.

    The search ends by `ftarget`, before it has more than `maxfevals` calls, as it converges, when `callback(progress)`
    returns `False` or raises `StopIteration`, or by a limit in `settings`, as a generation closes. Generations that
    close while the callback runs count too. `maxfevals` counts the calls for means too, and those by which a noisy
    search confirms its best ones at the end; of a call that fails and is tried again one. Only the first generation of
    all may exceed it, with `schedule` the last one too, and calls for candidates that are drawn anew or get other seeds
    since they failed. Where no mean fits in, none is evaluated, and `fun` is the best candidate's value.
    The search begins anew up to `restarts` times, while a whole generation fits in, from a random point within bounds,
    else from `x0`: with twice the population (`ipop`), or with large and small ones in turn (`bipop`). `settings` are
    those of `start_run`, such as `generations`, `optimiser`, `episodes`, `seed` or `listen`; with `workers=0` only
    other hosts score. `UsageError` for a wrong setting, for a function that fails at `x0`, or if all candidates fail
    before one has a value.

    >>> import dreamfleet, numpy as np
    >>> found = dreamfleet.minimise(np.linalg.norm, x0=[3, 4], sigma0=1, ftarget=0.01, workers=1)
    >>> found.fun <= 0.01, found.success, bool(np.abs(found.x).max() <= 0.01)
    (True, True, True)
    """
    given = {"penalty": penalty, "minimise": True, "integer": integer, "log": log}
    found = _Searches(function, x0, sigma0, bounds, given, ftarget, maxfevals, callback, workers, runs_dir, settings)
    return found.search(run, popsize, restarts, restart)


def maximise(
    function: Callable[..., Any] | str, x0: Sequence[float] | Floats, sigma0: float | Sequence[float] | None = None, *,
    bounds: Any = None, integer: Sequence[int] | bool = (), log: Sequence[int] | bool = (),
    ftarget: float | None = None, maxfevals: int | None = None, popsize: int | None = None, restarts: int = 0,
    restart: Restart = "ipop", penalty: float | None = None, callback: Callback | None = None,
    workers: int | None = None, run: str | None = None, runs_dir: Path | str | None = None, **settings: Any,
) -> SearchResult:  # fmt: skip
    """Search a maximum of `function(x)`; all else is as in `minimise`.

    >>> import dreamfleet, numpy as np
    >>> found = dreamfleet.maximise("numpy:min", x0=[0, 0], sigma0=1, bounds=(-1, 2), ftarget=1.9, workers=1)
    >>> found.fun >= 1.9
    True
    """
    given = {"penalty": penalty, "minimise": False, "integer": integer, "log": log}
    found = _Searches(function, x0, sigma0, bounds, given, ftarget, maxfevals, callback, workers, runs_dir, settings)
    return found.search(run, popsize, restarts, restart)


class _Plan(NamedTuple):
    """One search of several: its population, its first step in steps of sigma0, its seed, and most calls."""

    popsize: int
    sigma: float
    seed: int
    calls: int  # 0: as many as it takes


class _Searches:
    """A search and its restarts, each a run."""

    def __init__(
        self, function: Callable[..., Any] | str, x0: Any, sigma0: Any, bounds: Any, given: dict[str, Any],
        ftarget: float | None, maxfevals: int | None, callback: Callback | None, workers: int | None,
        runs_dir: Path | str | None, settings: dict[str, Any],
    ) -> None:  # fmt: skip
        check_names(settings)
        self._objective = read_objective(x0, sigma0, bounds, given)
        self._function, self._is_noisy, self._settings = name_function(function), is_noisy(function), settings
        self._ftarget, self._maxfevals, self._callback = ftarget, maxfevals, callback
        self._budget = maxfevals or 0  # 0: no limit
        self._workers, self._runs_dir = workers, runs_dir
        self._best: tuple[float, Floats] | None = None  # fitness and arguments of the best candidate
        self._favorite: tuple[float, Floats] | None = None  # of the best evaluated mean
        self._history: list[Progress] = []
        self._before: list[tuple[int, tuple[float, Floats] | None, int]] = []  # calls, best and failed before each
        self._first = 0  # index of the open search's first generation
        self._runs: list[str] = []
        self._calls = 0  # for candidates
        self._results = 0  # for means too
        self._stopped = False
        self._failed = 0  # candidates
        self._first_failure = ""  # why the first one failed

    def search(self, name: str | None, popsize: int | None, restarts: int, kind: Restart) -> SearchResult:
        """Search, restart while nothing else ends it, and say what was found; `UsageError` for wrong settings."""
        if kind not in ("ipop", "bipop"):
            raise UsageError(f"restart must be 'ipop' or 'bipop', not {kind!r}")
        numbers = (
            ("restarts", restarts, 0), ("popsize", popsize, 2), ("maxfevals", self._maxfevals, 1),
            ("generations", self._settings.get("generations"), 0),
        )  # fmt: skip
        for what, value, least in numbers:
            if value is not None and not (isinstance(value, (int, np.integer)) and least <= value <= MOST):
                raise UsageError(f"{what} must be a whole number from {least} to {MOST:,}, not {value!r:.100}")
        if self._ftarget is not None and not isinstance(self._ftarget, (int, float, np.number)):
            raise UsageError(f"ftarget must be a number, not {self._ftarget!r:.100}")
        if name is not None and not isinstance(name, str):
            raise UsageError(f"run must be a name, not {name!r:.100}")
        folder = default_runs_dir() if self._runs_dir is None else Path(self._runs_dir)
        if name is not None and has_begun(folder, name):
            raise UsageError(
                f"run {name} exists, and a search is always a new one: give another name to run=, or none, or delete "
                f"it by `{run_command(folder / name, 'runs', 'delete')}`"
            )
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"runs_dir {folder} cannot be created ({error.strerror}): choose another") from error
        size, seed = self._objective.dimension, read_seed(self._settings.pop("seed", 1))
        first = popsize or 4 + math.floor(3 * math.log(size))
        if self._settings.get("optimiser", "cma") == "cma" and size <= FULL_DIMENSION:
            self._settings.setdefault("covariance", "full")
        for number, plan in enumerate(self._plans(first, seed, restarts, kind)):
            if number and self._budget and not generations_within(self._left, self._settings_of(plan)):
                break
            own = f"{self._runs[0]}-restart-{number}" if number else name
            reason = self._run(own, plan, number)
            if self._stopped or self._has_reached:
                break
        return self._result(reason)

    def _plans(self, popsize: int, seed: int, restarts: int, kind: Restart) -> Iterator[_Plan]:
        """The searches in turn; BIPOP as Hansen 2009, "Benchmarking a BI-population CMA-ES on BBOB-2009"."""
        random, large, small, doublings = np.random.default_rng(seed), 0, 0, 0
        yield _Plan(popsize, 1.0, seed, self._left)
        for number in range(1, restarts + 1):
            before = self._calls
            if kind == "ipop" or small >= large:
                doublings += 1
                yield _Plan(popsize * 2**doublings, 1.0, seed + number, self._left)
                large += self._calls - before
            else:
                share, factor = random.random() ** 2, 10 ** (-2 * random.random())
                size = max(popsize, math.floor(popsize * (2**doublings / 2) ** share))
                yield _Plan(size, factor, seed + number, min(filter(None, (self._left, max(large // 2, size)))))
                small += self._calls - before

    @property
    def _left(self) -> int:
        """Calls that are left for the next search; 0: no limit."""
        return self._budget - self._spent if self._budget else 0

    @property
    def _spent(self) -> int:
        """Calls so far: of the open search those for candidates, of ended ones those for means too."""
        return max(self._calls, self._results)

    @property
    def _has_reached(self) -> bool:
        found = self._favorite if self._is_noisy else self._best
        return self._ftarget is not None and found is not None and found[0] >= self._objective.value(self._ftarget)

    def _run(self, name: str | None, plan: _Plan, number: int) -> StopReason:
        """One search as a run; why it ended."""
        objective = self._objective_of(plan, number)
        settings = {"run": name, "task_options": objective.options, **self._settings_of(plan)}
        if plan.calls:
            settings |= limits_within(plan.calls, settings, is_first=not number)
        with start_run_in(self._function.environment, self._workers, self._runs_dir, settings) as run:
            self._runs.append(run.name)
            self._first = len(self._history)
            for text in () if number else run.warnings:
                warnings.warn(text, RuntimeWarning, stacklevel=CALLER)
            ended = self._follow_all(run, objective)
        self._follow_rest(run, objective)
        self._read_means(run, objective)
        self._results += run.result_count()
        run.close()
        if self._has_reached:
            return StopReason(ended.kind, f"reached ftarget {format_number(self._ftarget)}")
        if ended.kind is StopKind.GENERATIONS and settings.get("generations") != self._settings.get("generations"):
            return StopReason(ended.kind, f"maxfevals={self._budget} is reached")
        return ended

    def _settings_of(self, plan: _Plan) -> dict[str, Any]:
        """The settings of a search's run that depend on no other search."""
        target = None if self._ftarget is None else self._objective.value(self._ftarget)
        patience = 50 + math.ceil(100 * self._objective.dimension / plan.popsize)
        return {
            "task": self._function.task, "population": plan.popsize, "sigma0": 1.0, "seed": plan.seed,
            "failure_limit": 1.0, **(NOISY if self._is_noisy else DETERMINISTIC),
            **({"target": target} if self._is_noisy else {"candidate_target": target, "stagnation": patience}),
            **self._settings,
        }  # fmt: skip

    def _follow_all(self, run: StartedRun, objective: Objective) -> StopReason:
        """Follow a run to its end; why it ended. `UsageError` if no candidate of the search has a value."""
        try:
            for generation in run:
                progress = self._follow(run, objective, generation)
                with suppress(StopIteration):
                    if self._callback is None or self._callback(progress) is not False:
                        continue
                self._stopped = True
                return StopReason(None, "stopped by the callback")
        except RunPausedError as pause:
            self._follow_rest(run, objective)
            if self._best is not None and run.failures():
                self._note_failures(run, run.settings.population)
                return StopReason(None, f"all candidates of generation {len(run.history())} failed")
            errors = [*(each.error for each in run.failures()), *pause.errors]
            if self._best is not None or not errors:
                raise
            raise UsageError(
                f"no candidate has a value, first: {errors[0]}. Begin where the function has one (x0, a "
                "smaller sigma0, bounds), or give a penalty in place of NaN and infinity"
            ) from None
        return StopReason(run.stop_kind, run.ended or run.state)

    def _follow_rest(self, run: StartedRun, objective: Objective) -> None:
        """Note what closed since the last report, so that all numbers are of one moment; the callback is not called.

        What a recall took back and nothing replaced is forgotten.
        """
        for generation in run.new_generations():
            self._follow(run, objective, generation)
        self._forget_from(self._first + len(run.history()))

    def _objective_of(self, plan: _Plan, number: int) -> Objective:
        """Where a search begins: the first at x0, a restart at random within bounds, or at x0 if there are none."""
        found = replace(self._objective, scale=tuple(plan.sigma * each for each in self._objective.scale))
        if not number:
            return found
        random = np.random.default_rng(plan.seed)
        start = list(found.x0)
        for index, (lower, upper) in enumerate(zip(found.lower, found.upper, strict=True)):
            if math.isfinite(lower) and math.isfinite(upper):
                ends = (math.log(lower), math.log(upper)) if index in found.log else (lower, upper)
                drawn = random.uniform(*ends)
                start[index] = min(max(math.exp(drawn) if index in found.log else drawn, lower), upper)
        return replace(found, x0=tuple(start))

    def _follow(self, run: StartedRun, objective: Objective, generation: StoredGeneration) -> Progress:
        """Note a closed generation; one that closes again after a recall replaces itself and those after it."""
        self._forget_from(self._first + generation.number)
        self._before.append((self._calls, self._best, self._failed))
        self._calls += generation.steps
        self._note_failures(run, generation.failed)
        if self._best is None or generation.best > self._best[0]:
            number = next((each for each in range(run.settings.population)
                           if run.fitness(generation.number, each) == generation.best), None)  # fmt: skip
            if number is not None:
                self._best = generation.best, objective.decode(run.candidate(generation.number, number))
        assert self._best is not None or not math.isfinite(generation.best)
        fitness, x = self._best or (math.nan, np.array(objective.x0))
        progress = Progress(
            run.name, generation.number, self._calls, x.copy(), objective.value(fitness),
            objective.value(generation.mean), generation.sigma,
        )  # fmt: skip
        self._history.append(progress)
        return progress

    def _forget_from(self, index: int) -> None:
        """Drop the noted generations from this one on, with what was counted and found in them."""
        if index < len(self._history):
            self._calls, self._best, self._failed = self._before[index]
            del self._history[index:], self._before[index:]

    def _note_failures(self, run: StartedRun, failed: int) -> None:
        """Count failed candidates, and warn of the first one."""
        if failed and not self._failed:
            errors = (each.error for each in run.failures() if each.kind == "score")
            self._first_failure = next(errors, "its error is in the log")
            text = f"{self._first_failure}; failed candidates rank last, and only this one is warned of"
            warnings.warn(text, RuntimeWarning, stacklevel=CALLER + 3)
        self._failed += failed

    def _read_means(self, run: StartedRun, objective: Objective) -> None:
        """Keep the best of the means that the runs report, each by its own score."""
        found = run.reported()
        if found is not None and (self._favorite is None or found.mean > self._favorite[0]):
            self._favorite = found.mean, objective.decode(run.evaluated_mean(found.generation))

    def _result(self, reason: StopReason) -> SearchResult:
        if self._best is None:
            raise UsageError(f"the search ended before its first generation closed: {reason.text}")
        best, favorite = self._best, self._favorite or self._best
        fitness, x = favorite if self._is_noisy else max(best, favorite, key=lambda each: each[0])
        converged, message = self._ftarget is None and reason.kind in CONVERGED, reason.text
        if self._failed:
            message += f"; {plural(self._failed, 'candidate')} failed, first: {self._first_failure}"
        return SearchResult(
            x, self._objective.value(fitness), self._results, len(self._history), message,
            self._has_reached or converged, tuple(self._history), tuple(self._runs), best[1], favorite[1],
        )  # fmt: skip
