"""Records of a run's curves in other programs: TensorBoard, Weights & Biases, MLflow."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Protocol

from dreamfleet.common.errors import UsageError
from dreamfleet.common.files.atomic_write import reporting_write_errors
from dreamfleet.common.files.regular_files import is_file
from dreamfleet.common.files.tensorboard import open_event_file, read_scalars
from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.coordinator.settings.live_log import SinkName

PROJECT = "dreamfleet"  # of Weights & Biases, and the experiment of MLflow
OWNER = "run_uid"  # a file beside TensorBoard's, with the identity of the run that writes there
LONGEST_VALUE, BATCH = 500, 1000  # characters of a setting's text in MLflow, and metrics of a request
# Of MLflow's client, whose defaults report an absent server after minutes; a record is tried again anyway.
IMPATIENCE = {"MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1", "MLFLOW_HTTP_REQUEST_TIMEOUT": "10"}


class Sink(Protocol):
    """A record of one run, new or continued; any method may raise any error.

    `known` is what the record holds, by name and step; names have `__` where programs have `/`.
    """

    known: dict[str, dict[int, float]]

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Add numbers of one step; they are in the record after `flush`."""

    def flush(self) -> None:
        """Write what was added."""

    def rewind(self, step: int) -> None:
        """Discard what the record holds from this step on, where the program can."""

    def close(self) -> None:
        """End the record so that it can be continued."""


def open_sink(name: SinkName, run: RunFolder) -> Sink:
    """Open the record of a run."""
    kinds: dict[str, Callable[[str, RunFolder], Sink]] = {
        "tensorboard": TensorBoardSink, "wandb": WandbSink, "mlflow": MlflowSink,
    }  # fmt: skip
    return kinds[name.kind](name.where, run)


class TensorBoardSink:
    """Event files in the run's folder, or in its own folder below the one that is named."""

    def __init__(self, where: str, run: RunFolder) -> None:
        self._folder = Path(where) / run.name if where else run.path / "tensorboard"
        owner = self._folder / OWNER
        if is_file(owner) and owner.read_text() != run.uid:
            raise UsageError(f"{self._folder} holds the curves of another run of this name, so name another folder")
        self.known = _plain(read_scalars(self._folder))
        self._stack = ExitStack()
        self._events = self._stack.enter_context(open_event_file(self._folder))
        owner.write_text(run.uid)
        if not self.known:
            self._events.add_text("settings", f"```\n{run.settings.to_json()}\n```")

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Write one record."""
        with reporting_write_errors(self._folder):
            self._events.add(step, **numbers)

    def flush(self) -> None:
        """`log` has written it."""

    def rewind(self, step: int) -> None:
        """Begin a session at the step: TensorBoard discards earlier points from there on."""
        self._events.begin(step)
        self.known = {name: {at: each for at, each in one.items() if at < step} for name, one in self.known.items()}

    def close(self) -> None:
        """Close the file."""
        self._stack.close()


class WandbSink:
    """A run of Weights & Biases with the run's own identity; its files are in the run's folder."""

    def __init__(self, where: str, run: RunFolder) -> None:
        import wandb

        rows = list(_wandb_rows(run.path / "wandb", run.uid))
        self.known: dict[str, dict[int, float]] = {}
        for row in rows:
            step = int(row.get("generation", -1))
            for name, value in row.items():
                if "/" in name and isinstance(value, (int, float)):
                    self.known.setdefault(name.replace("/", "__"), {})[step] = value
        quiet = wandb.Settings(
            console="off", silent=True, disable_git=True, save_code=False, x_disable_stats=True, init_timeout=30
        )
        project = where or os.environ.get("WANDB_PROJECT") or PROJECT
        self._run = wandb.init(
            project=project, id=run.uid, name=run.name, dir=str(run.path), resume="allow", config=_settings(run),
            settings=quiet,
        )  # fmt: skip
        self._run.define_metric("generation")
        self._run.define_metric("*", step_metric="generation")
        self._row = max(self._run.step, len(rows))  # their own count of rows, which must rise

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Add a row."""
        named = {name.replace("__", "/"): value for name, value in numbers.items()}
        self._run.log({"generation": step, **named}, step=self._row)
        self._row += 1

    def flush(self) -> None:
        """Their own process writes it."""

    def rewind(self, step: int) -> None:
        """Nothing is discarded there: the later of two points counts."""

    def close(self) -> None:
        """Hand everything over."""
        self._run.finish()


class MlflowSink:
    """A run of MLflow, found again by the run's identity in a tag."""

    def __init__(self, where: str, run: RunFolder) -> None:
        for name, value in IMPATIENCE.items():
            os.environ.setdefault(name, value)
        from mlflow import MlflowClient
        from mlflow.entities import Param

        self._client, self._kept = MlflowClient(tracking_uri=where or None), list[Any]()
        name = os.environ.get("MLFLOW_EXPERIMENT_NAME") or PROJECT
        experiment = self._client.get_experiment_by_name(name)
        home = experiment.experiment_id if experiment else self._client.create_experiment(name)
        found = self._client.search_runs([home], f"tags.`{PROJECT}.run` = '{run.uid}'")
        self.known: dict[str, dict[int, float]] = {}
        if found:
            self._id = found[0].info.run_id
            for key in found[0].data.metrics:
                points = self._client.get_metric_history(self._id, key)
                self.known[key.replace("/", "__")] = {each.step: each.value for each in points}
            self._client.update_run(self._id, status="RUNNING")
        else:
            self._id = self._client.create_run(home, run_name=run.name, tags={f"{PROJECT}.run": run.uid}).info.run_id
            texts = [Param(key, str(value)[:LONGEST_VALUE]) for key, value in _settings(run).items()]
            self._client.log_batch(self._id, params=texts)

    def log(self, step: int, numbers: Mapping[str, float]) -> None:
        """Keep metrics for the next request."""
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        self._kept += [Metric(name.replace("__", "/"), value, now, step) for name, value in numbers.items()]

    def flush(self) -> None:
        """Send them, many in one request."""
        while self._kept:
            self._client.log_batch(self._id, metrics=self._kept[:BATCH])
            del self._kept[:BATCH]

    def rewind(self, step: int) -> None:
        """Nothing is discarded there: the later of two points counts."""

    def close(self) -> None:
        """Mark the run as finished; a continued one runs again."""
        self._client.set_terminated(self._id)


def _plain(found: Mapping[str, dict[int, float]]) -> dict[str, dict[int, float]]:
    return {name.replace("/", "__"): points for name, points in found.items()}


def _settings(run: RunFolder) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(run.settings.to_json())
    return found


def _wandb_rows(folder: Path, uid: str) -> Iterator[dict[str, Any]]:
    """The rows that earlier lives of a run left on this disk: only these are surely recorded after a kill."""
    from wandb.proto.wandb_internal_pb2 import Record

    for path in sorted(folder.glob(f"*run-2*-{uid}/*.wandb")):
        for data in _log_records(path.read_bytes()):
            record = Record.FromString(data)
            if record.HasField("history"):
                items = record.history.item
                yield {each.key or "/".join(each.nested_key): json.loads(each.value_json) for each in items}


def _log_records(data: bytes, block: int = 32_768) -> Iterator[bytes]:
    """The whole records of LevelDB's log format: parts with checksum, size and kind, which cross no block's end."""
    at, parts = 7, b""  # after the file's own head
    while at + 7 <= len(data):
        if (left := block - at % block) < 7:
            at += left
            continue
        size, kind = int.from_bytes(data[at + 4 : at + 6], "little"), data[at + 6]
        parts = (b"" if kind in (1, 2) else parts) + data[at + 7 : at + 7 + size]  # 1 and 2 begin a record
        at += 7 + size
        if at <= len(data) and kind in (1, 4):  # 1 and 4 end it
            yield parts
