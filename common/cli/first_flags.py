"""The flags that `VERB --help` shows, of verbs with more than people want to read at once; `--help-all` shows all."""

from __future__ import annotations

from collections.abc import Mapping

# Every verb has these; only `--help-all` shows them.
FLAGS_OF_ALL = frozenset({"--config", "--log-level", "--log-format", "--trust", "--quiet"})
# By the name of the verb's entry point; a verb that is not here shows all its own flags.
FIRST_FLAGS: Mapping[str, tuple[str, ...]] = {
    "baseline.train": ("--preset", "--device", "--new", "--episodes", "--steps", "--seed", "--set", "--json"),
    "collect": (
        "--preset", "--task", "--environment", "--episodes", "--steps", "--seed", "--jobs", "--controller",
        "--driver", "--from-run", "--json",
    ),
    "coordinator": (
        "--run", "--resume", "--from", "--init", "--preset", "--task", "--bundle", "--population", "--episodes",
        "--horizon", "--seed", "--evaluate-every", "--generations", "--minutes", "--steps", "--target", "--listen",
        "--join", "--json",
    ),
    "dashboard": ("--connect", "--join", "--port", "--host", "--runs-dir", "--run"),
    "serve": ("--connect", "--join", "--port", "--host", "--token-file"),
    "demo": (
        "--world", "--run", "--dream-minutes", "--minutes", "--population", "--episodes", "--tracks", "--seed",
        "--workers", "--page",
    ),
    "evaluate": (
        "--controller", "--run", "--task", "--connect", "--episodes", "--first-seed", "--bundle", "--jobs", "--out",
        "--json",
    ),
    "inspect": (
        "--out", "--data", "--picture", "--controller", "--seed", "--steps", "--probe", "--losses", "--likeness",
        "--survival", "--episodes", "--json",
    ),
    "iterate": (
        "--init", "--rounds", "--task", "--preset", "--drives", "--own-drives", "--run-flags", "--seed", "--local",
        "--jobs", "--device", "--redo", "--listen", "--json",
    ),
    "lab.contrast": ("--kind", "--seeds", "--mdnrnn-flags", "--run-flags", "--local", "--json"),
    "live": (
        "--connect", "--run", "--worker", "--best", "--controller", "--generation", "--seed", "--seconds", "--fps",
        "--out", "--temperature",
    ),
    "pipeline": (
        "--preset", "--task", "--environment", "--scale", "--seed", "--jobs", "--device", "--out", "--vae-flags",
        "--mdnrnn-flags", "--json",
    ),
    "spawn": (
        "--hosts", "--name", "--connect", "--join", "--check", "--follow", "--slots", "--ssh",
        "--remote-python", "--json",
    ),
    "story": ("--journal", "--worker", "--job", "--what", "--last", "--connect", "--json"),
    "sweep": (
        "--run", "--vary", "--resume", "--parallel", "--workers", "--listen", "--connect", "--json", "--runs-dir",
        "--task", "--bundle", "--preset", "--population", "--episodes", "--generations", "--minutes",
    ),
    "train": (
        "--preset", "--device", "--continue-from", "--new", "--summary", "--updates", "--batch", "--rate", "--seed",
        "--set", "--tensorboard", "--json",
    ),
    "verify.run": ("--run", "--bundle", "--optimiser", "--listen", "--connect", "--runs-dir", "--json"),
    "worker": (
        "--connect", "--join", "--run", "--any", "--runs", "--slots", "--name", "--task", "--exit-when-done",
        "--lifetime",
    ),
}  # fmt: skip
