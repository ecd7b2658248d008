"""The bridge's description of itself: OpenAPI 3.1."""

from __future__ import annotations

from typing import Any

from dreamfleet.common.host.packages import package_version
from dreamfleet.common.protocol.batches import LAST_SEED, MAX_CANDIDATES, MAX_SEEDS

_NULLABLE_NUMBER = {"type": ["number", "null"]}
_STATE = {"enum": ["waiting", "running", "complete", "cancelled"]}
_PARAMETERS = {name: {"name": name, "in": "path", "required": True, "schema": {"type": "string"}}
               for name in ("run", "id")}  # fmt: skip
_ERRORS = {
    "400": "malformed: the text says what is wrong; nothing was kept",
    "401": "no token, or another one",
    "404": "unknown: no such batch, or no live run of this name",
    "409": "conflict: the id belongs to another content. Or the run has a search of its own",
    "413": "too large: split the batch",
    "503": "busy: the coordinator does not answer now, or too much waits. Send the same again after Retry-After",
}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _content(name: str, media_type: str = "application/json") -> dict[str, Any]:
    return {media_type: {"schema": {"$ref": f"#/components/schemas/{name}"}}}


def _operation(summary: str, answers: dict[str, tuple[str, str]], *names: str, **more: Any) -> dict[str, Any]:
    """An operation that answers a status with a description and a schema; `names` are its path's parameters."""
    errors = {status: {"description": text, "content": _content("Error")} for status, text in _ERRORS.items()}
    good = {status: {"description": text, "content": _content(schema)} for status, (text, schema) in answers.items()}
    return {"summary": summary, "parameters": [_PARAMETERS[name] for name in names], "responses": {**good, **errors},
            **more}  # fmt: skip


def _schemas() -> dict[str, Any]:
    count, text = {"type": "integer", "minimum": 0}, {"type": "string"}
    batch = {
        "id": text, "run": text, "state": _STATE, "population": count, "size": count, "episodes": count,
        "done": {**count, "description": "candidates that have a fitness or an error"},
        "generation": {"type": ["integer", "null"], "description": "of the run; null while the batch waits"},
        "run_state": text, "run_why": {**text, "description": "why the run is paused"},
    }  # fmt: skip
    return {
        "Submission": {
            **_object(
                id={**text, "pattern": "^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$",
                    "description": "names the batch. The same id with the same content is the same batch"},
                vectors={"oneOf": [
                    {"type": "array", "minItems": 1, "maxItems": MAX_CANDIDATES,
                     "items": {"type": "array", "items": {"type": "number"}}},
                    {**_object(float32={**text, "contentEncoding": "base64"}, size=count),
                     "required": ["float32", "size"], "description": "float32, little-endian, row by row"},
                ]},
                seeds={"type": "array", "minItems": 1, "maxItems": MAX_SEEDS,
                       "items": {"type": "integer", "minimum": 0, "maximum": LAST_SEED}},
                episodes={"type": "integer", "minimum": 0, "maximum": MAX_SEEDS,
                          "description": "fresh seeds instead of given ones; 0: as many as the run's --episodes"},
            ),
            "required": ["vectors"],
        },
        "Batch": _object(**batch),
        "Batches": _object(batches={"type": "array", "items": _object(
            **{name: batch[name] for name in ("id", "state", "population", "generation")}
        )}),
        "Scores": _object(
            **batch,
            fitness={"type": "array", "items": _NULLABLE_NUMBER,
                     "description": "larger is better; null: not scored yet, or failed"},
            errors={"type": "object", "additionalProperties": text, "description": "why a candidate failed, by index"},
        ),
        "Run": _object(run=text, state=text, why=text, task=text, external={"type": "boolean"}, size=count,
                       episodes=count, slots=count),
        "Runs": _object(runs={"type": "array", "items": {"$ref": "#/components/schemas/Run"}}),
        "Events": {**text, "description": "`candidate` with index, fitness and error; at last `end` with the batch"},
        "Error": _object(error=text, text=text),
    }  # fmt: skip


def document() -> dict[str, Any]:
    """The whole description."""
    batch, scores = ("the batch", "Batch"), ("the batch, and the scores so far", "Scores")
    events = {"200": {"description": "events", "content": _content("Events", "text/event-stream")}}
    stream = _operation("Server-sent events, one for each candidate that is done", {}, "run", "id")
    stream["responses"] |= events
    body = {"required": True, "content": _content("Submission")}
    return {
        "openapi": "3.1.0",
        "info": {"title": "dreamfleet: submitted batches", "version": package_version("dreamfleet") or "0"},
        "paths": {
            "/v1/health": {"get": {"summary": "Whether the bridge runs; needs no token",
                                   "responses": {"200": {"description": "it runs"}}}},
            "/v1/runs": {"get": _operation("The live runs", {"200": ("the runs", "Runs")})},
            "/v1/runs/{run}/batches": {
                "get": _operation(
                    "The open batches in their order, then finished ones, the last first; 512 at most",
                    {"200": ("the batches", "Batches")}, "run",
                ),
                "post": _operation(
                    "Submit a batch; it is on disk when this answers",
                    {"201": ("a new batch", "Batch"), "200": ("the batch was submitted before", "Batch")}, "run",
                    requestBody=body,
                ),
            },
            "/v1/runs/{run}/batches/{id}": {
                "get": _operation("A batch and its scores", {"200": scores}, "run", "id"),
                "delete": _operation("Cancel a batch; a finished one stays", {"200": batch}, "run", "id"),
            },
            "/v1/runs/{run}/batches/{id}/events": {"get": stream},
        },
        "components": {
            "schemas": _schemas(),
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{"token": []}, {}],
    }  # fmt: skip
