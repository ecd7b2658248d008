"""A run's closed generations as they are drawn and exported."""

import math
from dataclasses import replace

from dreamfleet.common.runs.records import StoredGeneration
from dreamfleet.common.runs.run_folder import RunFolder


def scored_history(run: RunFolder, since: int = 0) -> list[StoredGeneration]:
    """As `RunFolder.history`, with NaN for the fitness of generations in which no candidate has one."""
    nan, unscored = math.nan, run.unscored_generations()
    return [
        replace(each, mean=nan, std=nan, best=nan, worst=nan) if each.number in unscored else each
        for each in run.history(since)
    ]
