"""What `minimise` and `maximise` are given: numbers, bounds and parameters in the forms of SciPy and pycma.

Pages: own-objective.md.
"""

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dreamfleet.common.artifacts.objective import Objective
from dreamfleet.common.errors import UsageError
from dreamfleet.common.printable import plural, suggest
from dreamfleet.coordinator.jobs.confirmation import FINALISTS, total_episodes

MOST_SEED = 2**62  # a run has at most 2**63 - 1, and each restart has the next one
STEP_SHARE = 0.3  # of a parameter's range: Hansen 2016, "The CMA Evolution Strategy: A Tutorial", section B
OTHER_NAMES = {
    "maxfevals": "budget evaluations n_evaluations max_evaluations evals max_evals maxevals maxfun maxfev max_nfev "
                 "nfev n_calls calls n_trials trials",
    "generations": "maxiter max_iter n_iter niter iterations max_iterations n_generations max_generations ngen",
    "sigma0": "sigma sigma_0 step step_size stepsize initial_step std",
    "popsize": "pop_size population_size lam",
    "ftarget": "target candidate_target f_target fmin stop_fitness",
    "minutes": "timeout timelimit max_time time_limit maxtime",
    "workers": "n_workers n_jobs processes num_workers cores parallel",
    "optimiser": "optimizer method algorithm",
    "seed": "random_state rng",
    "bounds": "lower upper lb ub lower_bounds upper_bounds domain space dimensions",
    "integer": "integers integrality integer_variables",
    "run": "name run_name",
}  # fmt: skip
# Parameters of `minimise` that are no settings of a run.
OWN_NAMES = (
    "bounds", "integer", "log", "ftarget", "maxfevals", "popsize", "restarts", "restart", "penalty", "callback"
)  # fmt: skip
ADVICE = {
    **{name: f"did you mean {right!r}?" for right, names in OTHER_NAMES.items() for name in names.split()},
    **dict.fromkeys(
        ("tol", "ftol", "xtol", "fatol", "xatol", "tolfun", "tolx", "gtol"),
        "a search ends by itself as it converges; 'ftarget' ends it by a value, 'stagnation' after generations without "
        "a better one",
    ),
    **dict.fromkeys(
        ("disp", "verbose", "verb_disp", "display", "progress"),
        "a search prints nothing; `callback=print` prints each generation, and `dreamfleet status` shows the live run",
    ),
    **dict.fromkeys(
        ("args", "kwargs"),
        "a function has only `x`, and `seed`: at the top level of its module write `mine = functools.partial(cost, "
        "weight=3)`, and pass `mine`",
    ),
    **dict.fromkeys(("constraints", "constraint"), "return a worse value, or NaN, where a constraint does not hold"),
    **dict.fromkeys(("jac", "hess", "gradient"), "this search needs no derivative: leave it out"),
    "options": "give each of them as an argument of its own",
}


def check_names(settings: Mapping[str, Any]) -> None:
    """`UsageError` with the right name for what other libraries call a setting."""
    for name in settings:
        if name in ADVICE:
            raise UsageError(f"unknown setting {name!r}: {ADVICE[name]}")
        if near := suggest(name, OWN_NAMES, likeness=0.85, listed=False):
            raise UsageError(f"unknown setting {name!r}{near}")


def read_seed(value: Any) -> int:
    """The seed of a search; `UsageError` for what is none, or leaves no further ones for its restarts."""
    if not isinstance(value, (int, np.integer)) or isinstance(value, bool) or not 0 <= value <= MOST_SEED:
        raise UsageError(f"seed must be a whole number from 0 to {MOST_SEED:,}, not {value!r:.100}")
    return int(value)


def generations_within(budget: int, settings: Mapping[str, Any]) -> int:
    """After how many generations a search must end so that it has at most `budget` calls; 0: not one fits in.

    Every so many generations and at the end a mean is evaluated; at last the best means are confirmed. A candidate that
    fails counts as any other.

    >>> means = {"evaluate_every": 10, "evaluation_episodes": 20, "confirm_episodes": 20}
    >>> noisy = {"population": 6, "episodes": 2, **means}
    >>> generations_within(400, noisy), generations_within(400, {**noisy, "racing": True})
    (23, 30)
    >>> generations_within(400, {"population": 8}), generations_within(51, noisy), generations_within(7, noisy)
    (50, 0, 0)
    """
    names = ("population", "episodes", "evaluate_every", "evaluation_episodes", "confirm_episodes")
    try:
        population, episodes, every, evaluation, confirmed = (int(settings.get(name) or 0) for name in names)
        limit = int(settings.get("generations") or budget)
    except (TypeError, ValueError):  # the run refuses them
        return budget
    second = episodes // 2 if settings.get("racing") else 0  # only the better half of the candidates has these
    generation = max(population * max(episodes, 1) - population // 2 * second, 1)

    def calls(generations: int) -> int:
        means = -(-generations // every) if every > 0 else 0
        return generations * generation + means * evaluation + total_episodes(min(means, FINALISTS), confirmed)

    return min(limit, bisect_right(range(1, budget // generation + 1), budget, key=calls))


def limits_within(calls: int, settings: Mapping[str, Any], *, is_first: bool) -> dict[str, Any]:
    """Settings by which a search ends before it has more calls; the first one of all has one generation at least.

    Where no mean fits in beside it, none is evaluated.
    """
    limits = {"steps": settings.get("steps") or calls}  # for stages, which may have larger generations
    if found := generations_within(calls, settings) or not is_first:
        return {**limits, "generations": int(found)}
    limits |= {"evaluate_every": 0, "target": None}
    return {**limits, "generations": generations_within(calls, {**settings, **limits}) or 1}


def read_objective(x0: Any, sigma0: Any, bounds: Any, given: dict[str, Any]) -> Objective:
    """The objective in coordinates whose unit is `sigma0`, by default a share of each parameter's range."""
    start = _read_numbers("x0", x0)
    try:
        lower, upper = read_bounds(bounds, len(start))
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"bounds must be pairs of numbers, not {bounds!r:.100}") from error
    indices = {name: _read_indices(name, given[name]) for name in ("integer", "log")}
    if sigma0 is None:
        scale = _default_steps(len(start), lower, upper, indices["log"])
    else:
        scale = _read_numbers("sigma0", sigma0)
        if not all(0 < each < math.inf for each in scale):
            raise UsageError(f"sigma0 must be above 0, not {sigma0}")
    arguments = {"x0": start, "scale": scale[0] if len(scale) == 1 else scale, "lower": lower, "upper": upper}
    return Objective.of({**given, **arguments, **indices})


def _default_steps(size: int, lower: Any, upper: Any, log: bool | Sequence[int]) -> list[float]:
    """A first step for each parameter; `UsageError` for one whose range is not finite.

    >>> _default_steps(2, [0.0, 1.0], [10.0, math.e], [1])
    [3.0, 0.3]
    """
    ends = list(zip(lower or [None] * size, upper or [None] * size, strict=True))
    if open_ones := [index for index, pair in enumerate(ends) if None in pair]:
        raise UsageError(
            f"sigma0 is missing: give the first step, a number or one for each parameter. Only where all bounds are "
            f"finite it may be left out, and parameter {open_ones[0]} has none"
        )
    logarithmic = range(size if log else 0) if isinstance(log, bool) else log
    ranges = [
        math.log(high / low) if index in logarithmic and min(low, high) > 0 else high - low
        for index, (low, high) in enumerate(ends)
    ]
    return [STEP_SHARE * each if each > 0 else 1.0 for each in ranges]  # of a fixed parameter any


def _read_numbers(name: str, value: Any) -> list[float]:
    """One number or a row of them; `UsageError` for anything else."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"{name} must be a number or a row of numbers, not {value!r:.100}") from error
    if array.ndim > 1 or not array.size:
        raise UsageError(f"{name} must be a number or a row of numbers, not an array of shape {array.shape}")
    return [float(each) for each in array.reshape(-1)]


def _read_indices(name: str, value: Any) -> bool | list[int]:
    """Which parameters: all, none, one by its number, or several; `UsageError` for anything else."""
    if isinstance(value, bool):
        return value
    try:
        return [int(each) for each in np.asarray(value, dtype=np.int64).reshape(-1)]
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"{name} must be True, or the numbers of parameters, not {value!r:.100}") from error


def read_bounds(bounds: Any, size: int) -> tuple[Any, Any]:
    """Lower and upper bounds of scipy's pairs, of its `Bounds`, or of one pair for all."""
    if bounds is None:
        return None, None
    if hasattr(bounds, "lb") and hasattr(bounds, "ub"):
        pairs = np.broadcast_to(np.stack([bounds.lb, bounds.ub], axis=-1), (size, 2)).tolist()
    else:
        pairs = list(bounds)
        if len(pairs) == 2 and all(each is None or np.ndim(each) == 0 for each in pairs):
            pairs = [tuple(pairs)] * size
    if len(pairs) != size or not all(np.ndim(each) == 1 and len(each) == 2 for each in pairs):
        raise UsageError(f"bounds must be pairs (low, high) for {plural(size, 'parameter')}, or one pair of numbers")
    ends = [[None if each is None or math.isinf(each) else float(each) for each in side]
            for side in zip(*pairs, strict=True)]  # fmt: skip
    return ends[0], ends[1]
