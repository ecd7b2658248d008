"""The bridge's description of itself: OpenAPI 3.1."""

from typing import Any, get_args

from dreamfleet.common.host.packages import package_version
from dreamfleet.common.protocol.batches import (
    ID_PATTERN,
    LAST_SEED,
    MAX_BATCH,
    MAX_CANDIDATES,
    MAX_EPISODES,
    MAX_LISTED,
    MAX_SEEDS,
    Refusal,
)
from dreamfleet.common.protocol.keys import RUN_PATTERN

_NULLABLE_NUMBER = {"type": ["number", "null"]}
_STATE = {"enum": ["waiting", "running", "complete", "cancelled"]}
_NAMES = {"run": f"^{RUN_PATTERN}$", "id": f"^{ID_PATTERN}$"}
_PARAMETERS = {name: {"name": name, "in": "path", "required": True, "schema": {"type": "string", "pattern": pattern}}
               for name, pattern in _NAMES.items()}  # fmt: skip
_TOO_LARGE = float(2**128 - 2**103)  # the least number that single precision rounds to infinity
_BASE64 = "^(?:[A-Za-z0-9+/]{4})*(?:[A-Za-z0-9+/]{4}|[A-Za-z0-9+/]{3}=|[A-Za-z0-9+/]{2}==)$"
_GUARD = {"403": "forbidden: a web page of another site asks", "421": "misdirected: the Host is not this computer's"}
_ERRORS = {
    **_GUARD,
    "400": "malformed: the text says what is wrong; nothing was kept",
    "401": "unauthorised: no token, or another one",
    "404": "unknown: no such batch, or no live run of this name",
    "409": "conflict: the id belongs to another content. Or not external: the run has a search of its own",
    "502": "failed: the coordinator has another version, or this host cannot ask it",
    "503": "busy: the coordinator does not answer or cannot write now, or too much waits. Repeat after Retry-After",
}
_SUBMISSION_ERRORS = {
    "408": "malformed: no further byte of the body came in time",
    "413": "too large: split the batch",
    "415": "malformed: the body is no application/json",
}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": [*properties]}


def _content(name: str, media_type: str = "application/json") -> dict[str, Any]:
    return {media_type: {"schema": {"$ref": f"#/components/schemas/{name}"}}}


def _errors(texts: dict[str, str]) -> dict[str, Any]:
    return {status: {"description": text, "content": _content("Error")} for status, text in texts.items()}


def _operation(summary: str, answers: dict[str, tuple[str, str]], *names: str, **more: Any) -> dict[str, Any]:
    """An operation that answers a status with a description and a schema; `names` are its path's parameters."""
    errors = _errors(_ERRORS)
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
                id={**text, "pattern": _NAMES["id"],
                    "description": "names the batch. The same id with the same content is the same batch"},
                vectors={"oneOf": [
                    {"type": "array", "minItems": 1, "maxItems": MAX_CANDIDATES,
                     "description": "rows of one length, which is the run's `size`",
                     "items": {"type": "array", "minItems": 1, "items": {
                         "type": "number", "exclusiveMinimum": -_TOO_LARGE, "exclusiveMaximum": _TOO_LARGE}}},
                    {**_object(float32={**text, "contentEncoding": "base64", "pattern": _BASE64, "minLength": 8},
                               size={"type": "integer", "minimum": 1}), "additionalProperties": False,
                     "description": "finite numbers of single precision, little-endian, row by row, `size` in a row"},
                ]},
                seeds={"type": "array", "minItems": 1, "maxItems": MAX_SEEDS,
                       "items": {"type": "integer", "minimum": 0, "maximum": LAST_SEED}},
                episodes={"type": "integer", "minimum": 0, "maximum": MAX_SEEDS,
                          "description": "fresh seeds instead of given ones; 0: as many as the run's --episodes"},
            ),
            "required": ["vectors"], "additionalProperties": False, "not": {"required": ["seeds", "episodes"]},
            "description": f"At most {MAX_EPISODES:,} episodes, {MAX_BATCH >> 20} MiB of numbers, 16 MiB as text",
        },
        "Batch": _object(**batch),
        "Submitted": _object(**batch, remark={**text, "description": "on its seeds, such as test seeds; else empty"}),
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
        "Event": {
            **_object(event={"enum": ["candidate", "end", "error"]},
                      data={**text, "contentMediaType": "application/json"}),
            "description": "each event: `candidate` with index, fitness and error; at last `end` with the batch",
        },
        "Health": _object(status={"const": "ok"}, version={"type": ["string", "null"]}),
        "Error": _object(error={"enum": [*get_args(Refusal)[1:], "failed", "forbidden", "misdirected", "unauthorised"]},
                         text=text),
    }  # fmt: skip


def document(*, needs_token: bool) -> dict[str, Any]:
    """The whole description, of a bridge whose requests must bear a token or need none."""
    batch, scores = ("the batch", "Batch"), ("the batch, and the scores so far", "Scores")
    events = {"200": {"description": "events", "content": _content("Event", "text/event-stream")}}
    stream = _operation("Server-sent events, one for each candidate that is done", {}, "run", "id")
    stream["responses"] |= events
    submit = _operation(
        "Submit a batch; it is on disk when this answers",
        {"201": ("a new batch", "Submitted"), "200": ("the batch was submitted before", "Submitted")}, "run",
        requestBody={"required": True, "content": _content("Submission")},
    )  # fmt: skip
    submit["responses"] |= _errors(_SUBMISSION_ERRORS)
    return {
        "openapi": "3.1.0",
        "info": {"title": "dreamfleet: submitted batches", "version": package_version("dreamfleet") or "0"},
        "paths": {
            "/v1/health": {"get": {"summary": "Whether the bridge runs; needs no token", "security": [],
                                   "responses": {"200": {"description": "it runs", "content": _content("Health")},
                                                 **_errors(_GUARD)}}},
            "/v1/runs": {"get": _operation("The live runs", {"200": ("the runs", "Runs")})},
            "/v1/runs/{run}/batches": {
                "get": _operation(
                    f"The open batches in their order, then finished ones, the last first; {MAX_LISTED} at most",
                    {"200": ("the batches", "Batches")}, "run",
                ),
                "post": submit,
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
        "security": [{"token": []}] if needs_token else [],
    }  # fmt: skip
