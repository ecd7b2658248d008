"""Optimisers by name: those registered under the entry-point group, and any as `module:attribute`. Pages: trust.md."""

import difflib
import inspect
import re
from collections.abc import Iterable, Mapping
from importlib.metadata import entry_points
from typing import Any

from dreamfleet.common.errors import MissingExtraError, UsageError
from dreamfleet.common.host.packages import install_command_for
from dreamfleet.common.host.resource_limits import usable_memory
from dreamfleet.common.host.trusted_modules import find_attribute, import_trusted
from dreamfleet.common.host.user_code import user_code
from dreamfleet.common.printable import did_you_mean, plural
from dreamfleet.coordinator.optimisers.api import Footprint, Optimiser, Search

GROUP = "dreamfleet.optimisers"
LARGEST_STATE = 10**9  # bytes that SQLite keeps in one value
# What the field calls them elsewhere, without case and punctuation.
_OTHER_NAMES = {
    "openaies": "openes", "es": "openes", "pgpe": "pepg", "cmaes": "cma", "pycma": "cma", "sepcma": "cmaes-sep",
    "sepcmaes": "cmaes-sep", "lracma": "cmaes-lra", "lracmaes": "cmaes-lra", "nes": "xnes",
}  # fmt: skip
_OF_CLASS = tuple(Optimiser.__annotations__)
_OF_INSTANCE = tuple(name for name in vars(Optimiser) if not name.startswith("_"))


def known_optimisers() -> tuple[str, ...]:
    """Names of the registered optimisers."""
    return tuple(sorted(point.name for point in entry_points(group=GROUP)))


def build_optimiser(name: str, search: Search) -> Optimiser:
    """The optimiser `name`; `UsageError` if it is unknown, incomplete, lacks an option, or cannot do this search."""
    kind = _find(name)
    _refuse_incomplete(name, kind, _OF_CLASS)
    _refuse_unknown_options(name, kind.options, search.options)
    try:
        inspect.signature(kind).bind(search)
    except TypeError as error:
        raise UsageError(f"optimiser {name!r} must be built from one Search: {error}") from error
    with user_code(name.partition(":")[0], f"building optimiser {name!r}"):
        optimiser: Optimiser = kind(search)
    _refuse_incomplete(name, optimiser, _OF_INSTANCE)
    return optimiser


def check_memory(name: str, dimension: int, population: int, options: Mapping[str, str]) -> None:
    """`UsageError` if this host cannot hold such a search of the optimiser, or the journal its state."""
    count = getattr(_find(name), "footprint", None)
    if count is None:
        return
    needed: Footprint = count(dimension, population, options)
    own = f"optimiser {name} with {plural(dimension, 'parameter')} and a population of {population:,}"
    remedy = "give --covariance diagonal" if options.get("covariance") == "full" else (
        "give fewer --hidden-units, a smaller --population, or an optimiser of the diagonal alone (cma, cmaes-sep)"
    )  # fmt: skip
    if needed.memory > (here := usable_memory()):
        raise UsageError(
            f"{own} needs {needed.memory / 1e9:,.1f} GB of memory, this host has {here / 1e9:,.1f}: {remedy}"
        )
    if needed.state > LARGEST_STATE:
        raise UsageError(f"{own} has a state of {needed.state / 1e9:,.1f} GB, a journal keeps 1 GB at most: {remedy}")


def _find(name: str) -> Any:
    for point in entry_points(group=GROUP):
        if point.name == name:
            try:
                return point.load()
            except ModuleNotFoundError as error:
                remedy = install_command_for(error.name) or "install the package that has it"
                raise MissingExtraError(f"optimiser {name!r} needs the package {error.name!r}: {remedy}") from error
    module, _, attribute = name.partition(":")
    if not attribute:
        known, near = known_optimisers(), _suggest(name)
        raise UsageError(
            f"unknown optimiser {name!r}{did_you_mean([near]) if near else ':'} known are "
            f"{', '.join(known) or 'none'}, and your own as module:attribute"
        )
    try:
        return find_attribute(import_trusted(module, f"optimiser {name!r}"), attribute)
    except (ImportError, AttributeError) as error:
        raise UsageError(f"optimiser {name!r} cannot be loaded: {error}") from error


def _suggest(name: str) -> str:
    """The optimiser that an unknown name nearly is, or has elsewhere; empty: none.

    >>> _suggest("OpenAI-ES"), _suggest("SepCMA"), _suggest("adam")
    ('openes', 'cmaes-sep', '')
    """
    plain = {_plain(each): each for each in known_optimisers()} | _OTHER_NAMES
    near = difflib.get_close_matches(_plain(name), plain, n=1, cutoff=0.75)
    return plain[near[0]] if near else ""


def _plain(name: str) -> str:
    return re.sub(r"[^a-z]", "", name.lower())


def _refuse_incomplete(name: str, what: object, wanted: Iterable[str]) -> None:
    missing = [each for each in wanted if not hasattr(what, each)]
    if missing:
        raise UsageError(
            f"optimiser {name!r} lacks {', '.join(missing)}: dreamfleet.coordinator.optimisers.api says what each is"
        )


def _refuse_unknown_options(name: str, known: Mapping[str, str], given: Mapping[str, str]) -> None:
    for option in given.keys() - known.keys():
        knows = "; ".join(f"{each} ({text})" for each, text in known.items()) or "none"
        drop = "--covariance diagonal" if option == "covariance" else "--optimiser-options without it"
        raise UsageError(f"optimiser {name!r} has no option {option!r}, it knows: {knows}; give {drop}")
