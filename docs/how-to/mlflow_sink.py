"""A run's curves in MLflow: `log_to = ["mlflow_sink:MlflowSink"]`, or `"mlflow_sink:MlflowSink:ADDRESS"`.

Needs `pip install mlflow`. Without an address it writes to `MLFLOW_TRACKING_URI`.
"""

import json
import os
import time
from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

from dreamfleet.common.runs.run_folder import RunFolder

# The coordinator imports this module before the run begins. Only the process beside it imports the library.
if find_spec("mlflow") is None:
    raise ModuleNotFoundError("No module named 'mlflow': pip install mlflow")

TAG = "dreamfleet.run"  # holds the run's identity
LONGEST, BATCH = 500, 1000  # characters of a setting, and metrics of a request
# Their client reports an absent server after minutes; a record is tried again anyway.
for name, value in {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1", "MLFLOW_HTTP_REQUEST_TIMEOUT": "10"}.items():
    os.environ.setdefault(name, value)


class MlflowSink:
    """A run of MLflow, found again by the run's identity in a tag."""

    def __init__(self, where: str, run: RunFolder) -> None:
        from mlflow import MlflowClient
        from mlflow.entities import Param

        self._client, self._waiting = MlflowClient(tracking_uri=where or None), list[Any]()
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME") or "dreamfleet"
        experiment = self._client.get_experiment_by_name(name)
        home = experiment.experiment_id if experiment else self._client.create_experiment(name)
        found = self._client.search_runs([home], f"tags.`{TAG}` = '{run.uid}'")
        self.known: dict[str, dict[int, float]] = {}
        if not found:
            self._id = self._client.create_run(home, run_name=run.name, tags={TAG: run.uid}).info.run_id
            settings = json.loads(run.settings.to_json())
            self._client.log_batch(self._id, params=[Param(key, str(each)[:LONGEST]) for key, each in settings.items()])
            return
        self._id = found[0].info.run_id
        for key in found[0].data.metrics:
            points = self._client.get_metric_history(self._id, key)
            self.known[key.replace("/", "__")] = {each.step: each.value for each in points}
        self._client.update_run(self._id, status="RUNNING")

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Keep metrics for the next request."""
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        self._waiting += [Metric(name.replace("__", "/"), value, now, step) for name, value in numbers.items()]

    def flush(self) -> None:
        """Send them, many in one request."""
        while self._waiting:
            self._client.log_batch(self._id, metrics=self._waiting[:BATCH])
            del self._waiting[:BATCH]

    def rewind(self, step: int) -> None:
        """Nothing is discarded there: the later of two points counts."""

    def close(self) -> None:
        """Mark the run as finished; a continued one runs again."""
        self._client.set_terminated(self._id)
