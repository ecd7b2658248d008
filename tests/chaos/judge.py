"""Is the reported mean unbiased: a run's figure against the same controller on 100 tracks that nobody has seen.

python -m tests.chaos.judge --runs 20 --out build/judge.jsonl

Short dream runs on the shipped world model, each with a fixed number of generations and one slot, so that every figure
follows from the seed. A reported mean should lie within two standard errors of the difference, both errors counted.
Each finished run is a line of the file; the same command continues where it was interrupted.
"""

import argparse
import json
import math
import os
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.host.resource_limits import pin_thread_pools
from dreamfleet.common.runs.records import best_evaluation
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.common.runs.seeds import TEST
from tests.support.processes import processes_in

SETTINGS = {
    "preset": "dream", "bundle": "tiny", "population": 32, "episodes": 8, "generations": 10, "evaluate-every": 3,
    "evaluation-episodes": 4, "confirm-episodes": 24,
}  # fmt: skip
TRACKS = TEST[:100]
PATIENCE = 1800  # seconds of a run at most
LEAST = 0.9  # of the runs must report a fair mean


def evolve(processes, seed):
    """One run with one worker, to its end; its name."""
    name = f"judged-{seed}"
    flags = [text for flag, value in SETTINGS.items() for text in (f"--{flag}", value)]
    coordinator = processes.coordinator(*flags, "--seed", seed, name=name)
    processes.worker("--run", name, "--exit-when-done")
    code, _ = coordinator.finish(PATIENCE)
    assert code == 0, "".join(coordinator.lines)
    return name


def drive(controller):
    """Scores on the fresh tracks, in this process."""
    from dreamfleet.worker.addons.evaluation.agents import make_evaluation_spec
    from dreamfleet.worker.scoring.scorer import Scorer

    bundle = find_bundle(SETTINGS["bundle"])
    scorer = Scorer(make_evaluation_spec(controller, bundle), bundle)
    return [scorer.score("evaluate", controller.parameters, seed).fitness for seed in TRACKS]


def judge(seed):
    """One run and its controller on the fresh tracks: a line of the file."""
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    pin_thread_pools()
    started = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, processes_in(Path(folder)) as processes:
        name = evolve(processes, seed)
        evolved = time.monotonic()
        with open_run(processes.runs, name) as run:
            confirmed, lucky = run.confirmation(), best_evaluation(run.evaluations())
            controller = Controller.load(run.controller_path)
    scores = np.array(drive(controller))
    error = float(scores.std(ddof=1) / math.sqrt(len(scores)))
    return {
        "seed": seed, "settings": SETTINGS, "generation": confirmed.generation,
        "reported": confirmed.mean, "error": confirmed.error, "episodes": confirmed.episodes,
        "best_evaluation": lucky.mean, "best_evaluation_error": lucky.error,
        "fresh": float(scores.mean()), "fresh_error": error, "tracks": len(scores),
        "off_by": (confirmed.mean - float(scores.mean())) / math.hypot(confirmed.error, error),
        "seconds": [round(evolved - started, 1), round(time.monotonic() - evolved, 1)],
    }  # fmt: skip


def finished(path):
    """The lines of an earlier call with the same settings, by seed."""
    lines = map(json.loads, path.read_text().splitlines()) if path.exists() else ()
    return {line["seed"]: line for line in lines if line["settings"] == SETTINGS}


def summary(lines):
    """How many reported means lie within two standard errors, and how far they and the best evaluations are off."""
    within = sum(abs(line["off_by"]) <= 2 for line in lines)
    return {
        "runs": len(lines),
        "within_two_errors": within,
        "mean_off_by": round(float(np.mean([line["reported"] - line["fresh"] for line in lines])), 1),
        "best_evaluation_off_by": round(float(np.mean([line["best_evaluation"] - line["fresh"] for line in lines])), 1),
        "passed": within >= math.ceil(LEAST * len(lines)),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--first-seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2, help="runs side by side, a core each")
    parser.add_argument("--out", type=Path, default=Path("build/judge.jsonl"), help="a line a finished run")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    args = parser.parse_args()
    seeds = range(args.first_seed, args.first_seed + args.runs)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    missing = [seed for seed in seeds if seed not in finished(args.out)]
    with ProcessPoolExecutor(args.jobs, get_context("spawn"), max_tasks_per_child=1) as pool:
        for done in as_completed([pool.submit(judge, seed) for seed in missing]):
            line = done.result()
            with args.out.open("a") as file:
                file.write(json.dumps(line) + "\n")
            print(
                f"seed {line['seed']}: reported {line['reported']:.1f} ± {line['error']:.1f}, fresh "
                f"{line['fresh']:.1f} ± {line['fresh_error']:.1f}, off by {line['off_by']:+.2f} errors, "
                f"{sum(line['seconds']):.0f} s",
                file=sys.stderr,
            )
    lines = finished(args.out)
    report = summary([lines[seed] for seed in seeds])
    print(json.dumps(report) if args.json else "\n".join(f"{name}: {value}" for name, value in report.items()))
    return 0 if report["passed"] else 1


if __name__ == "__main__":
    raise SystemExit(main())
