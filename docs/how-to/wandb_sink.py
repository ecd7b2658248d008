"""A run's curves in Weights & Biases: `log_to = ["wandb_sink:WandbSink"]`, or `"wandb_sink:WandbSink:PROJECT"`.

Needs `pip install wandb`. With `WANDB_MODE=offline` each life of a run writes all curves again, in a folder of its own.
"""

import json
import os
from collections.abc import Mapping
from importlib.util import find_spec

from dreamfleet.common.runs.run_folder import RunFolder

# The coordinator imports this module before the run begins. Only the process beside it imports the library.
if find_spec("wandb") is None:
    raise ModuleNotFoundError("No module named 'wandb': pip install wandb")


class WandbSink:
    """A run of Weights & Biases with the run's own identity; its files are in the run's folder."""

    def __init__(self, where: str, run: RunFolder) -> None:
        import wandb

        self._run = wandb.init(
            project=where or os.environ.get("WANDB_PROJECT") or "dreamfleet",
            id=run.uid,
            name=run.name,
            dir=str(run.path),
            resume="allow",
            config=json.loads(run.settings.to_json()),
            settings=wandb.Settings(
                console="off", silent=True, disable_git=True, save_code=False, x_disable_stats=True, init_timeout=30
            ),
        )
        self._run.define_metric("generation")
        self._run.define_metric("*", step_metric="generation")
        self.known: dict[str, dict[int, float]] = {}
        if self._run.resumed:
            for row in wandb.Api().run(self._run.path).scan_history():
                for key, value in row.items():
                    if "/" in key and isinstance(value, (int, float)):
                        self.known.setdefault(key.replace("/", "__"), {})[int(row["generation"])] = value

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Add a row. Their own step counts rows, as a score comes after the fitness of later generations."""
        self._run.log({"generation": step, **{name.replace("__", "/"): value for name, value in numbers.items()}})

    def flush(self) -> None:
        """Their own process writes it."""

    def rewind(self, step: int) -> None:
        """Nothing is discarded there: the later of two points counts."""

    def close(self) -> None:
        """Hand everything over."""
        self._run.finish()
