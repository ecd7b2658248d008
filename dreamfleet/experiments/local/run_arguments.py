"""Settings of `start_run` and `evolve`. `make reference` writes it: change `RunConfig`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict

_Keywords = TypedDict("_Keywords", {"from": str | None}, total=False)  # words of Python: given by `**`


class RunArguments(_Keywords, total=False):
    """The flags of `dreamfleet coordinator`, with `_` for `-`; docs/reference/verbs.md says what each means."""

    run: str | None
    resume: str | None
    init: str | Path | None
    preset: str | None
    task: str | None
    bundle: str | Path | None
    environment: Mapping[str, Any] | Sequence[str] | None
    observation: str | Sequence[str] | None
    normalise: bool | None
    task_options: str | None
    variant: Mapping[str, Any] | Sequence[str] | None
    controller: Literal["linear", "hidden"] | None
    hidden_units: int | None
    features: Literal["zh", "z"] | None
    population: int | None
    episodes: int | None
    sigma0: float | None
    optimiser: str | None
    optimiser_options: Mapping[str, Any] | Sequence[str] | None
    archive: str | Sequence[str] | None
    covariance: Literal["diagonal", "full"] | None
    subspace: str | Path | None
    racing: bool | None
    horizon: int | None
    patience: int | None
    temperature: float | None
    recorded: float | None
    end: str | None
    driven: float | None
    on_failure: Literal["worst", "redraw", "pause"] | None
    seed: int | None
    evaluate_every: int | None
    evaluation_episodes: int | None
    confirm_episodes: int | None
    collect_every: int | None
    collect_episodes: int | None
    schedule: str | Path | None
    generations: int | None
    steps: int | None
    minutes: float | None
    target: float | None
    candidate_target: float | None
    stagnation: int | None
    parted: int | None
    listen: str | Sequence[str] | None
    beat: float | None
    evaluation_share: float | None
    failure_limit: float | None
    share: float | None
    strict: bool | None
    verify: float | None
    metrics_port: int | str | None
    insecure: bool | None
    trust: str | Sequence[str] | None
    log_level: Literal["debug", "info", "warning", "error"] | None
    log_format: Literal["text", "json", "auto"] | None
