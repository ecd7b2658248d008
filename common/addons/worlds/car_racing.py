"""CarRacing: presets of its runs, its published scores and its demonstration. Pages: stages.md, watch.md, train.md."""

from typing import Any

from dreamfleet.common.artifacts.car_racing_variants import CAR_RACING, FACTS
from dreamfleet.common.runs.records import StageSettings
from dreamfleet.common.worlds.profile import DemoPlan, PublishedScore, PublishedScores, ShippedScore, WorldProfile

# Reality from nothing, in the features that ship: one track a candidate by large steps until a mean is able, then ever
# more tracks. A candidate pays for the grass, because who drives there soon misses tiles (docs/lab/results.md).
REAL: dict[str, Any] = {
    "task": "car-racing",
    "bundle": "tiny-int8",
    "subspace": "real",
    "preset_variant": ("offroad_cost=0.5",),
    "population": 24,
    "episodes": 1,
    "sigma0": 0.3,
    "covariance": "full",
    "horizon": 1000,
    "patience": 100,
    "evaluate_every": 3,
    "evaluation_episodes": 32,
    "confirm_episodes": 256,
    "stages": (
        StageSettings(score=870.0, steps=300_000),
        *[StageSettings(score=870.0, steps=300_000, restart=True)] * 9,
        StageSettings(steps=1_200_000, episodes=4, sigma0=0.06),
        StageSettings(steps=2_500_000, episodes=8),
        StageSettings(episodes=16),
    ),
}
# Each candidate drives one track and dreams another, after a few generations of dreams alone: docs/lab/dreams-notes.md,
# "Some of reality in it".
MIXED: dict[str, Any] = {
    "task": "dream",
    "bundle": "tiny",
    "subspace": "tiny",
    "population": 64,
    "episodes": 16,
    "sigma0": 0.3,
    "covariance": "full",
    "horizon": 400,
    "temperature": 1.5,
    "evaluate_every": 5,
    "evaluation_episodes": 32,
    "confirm_episodes": 64,
    "stages": (
        StageSettings(generations=5),
        StageSettings(driven=0.5, horizon=1000, patience=100, population=24, episodes=2, sigma0=0.15),
    ),
}
# Both pedals of these two sources are half down at an output of 0.
HALF_PEDALS = ("pedals=half",)
ARTICLE: dict[str, Any] = {
    "preset_variant": HALF_PEDALS,
    "population": 32,
    "episodes": 4,
    "sigma0": 0.1,
    "covariance": "full",
    "evaluation_episodes": 100,
}
# Ten generations of dreams, and then a drive.
NOTEBOOK: dict[str, Any] = {
    "task": "dream",
    "preset_variant": HALF_PEDALS,
    "population": 256,
    "episodes": 5,
    "sigma0": 0.1,
    "covariance": "full",
    "horizon": 1000,
    "temperature": 1.0,
    "evaluate_every": 10,
    "evaluation_episodes": 16,
}
PAPER: dict[str, Any] = {
    "population": 64, "episodes": 16, "sigma0": 0.1, "covariance": "full", "evaluation_episodes": 1024,
}  # fmt: skip
# What two cores do in minutes.
DREAM: dict[str, Any] = {
    "task": "dream",
    "population": 64,
    "episodes": 16,
    "sigma0": 0.1,
    "covariance": "diagonal",
    "horizon": 400,
    "temperature": 1.5,
    "evaluate_every": 5,
    "evaluation_episodes": 16,
    "confirm_episodes": 32,
}
FRUGAL: dict[str, Any] = {
    "population": 32, "episodes": 2, "sigma0": 0.1, "covariance": "diagonal", "patience": 100,
}  # fmt: skip
PROFILE = WorldProfile(
    task=CAR_RACING,
    score_word=FACTS.score_word,
    score_unit="points",
    end_texts={"finished": "lap finished", "terminated": "left the track", "truncated": "time's up"},
    shipped_scores=(
        ShippedScore("102a4956f6d4", 915.2, 3.0, 100, 10012),  # real
        ShippedScore("d362a710afb1", 914.0, 2.9, 100, 10015),  # real-from-nothing
        ShippedScore("7d07a615d149", 905.5, 3.3, 100, 10076),  # dream
        ShippedScore("e987f25edac2", 832.1, 14.3, 100, 10060),  # tiny
    ),
    run_presets={
        "article": ARTICLE,
        "dream": DREAM,
        "frugal": FRUGAL,
        "mixed": MIXED,
        "notebook": NOTEBOOK,
        "paper": PAPER,
        "real": REAL,
    },
    dream_preset="dream",
    default_training="tiny",
    # The public log of the experiment: the evaluated mean on 1024 tracks. Steps count candidates only. Only the total
    # time is known: 1119 hours on 64 cores.
    published=PublishedScores(
        "Ha & Schmidhuber 2018, their public log (1024 tracks; of its time the end alone is known)",
        (
            PublishedScore(2.6e7, 823),
            PublishedScore(1.0e8, 867),
            PublishedScore(7.8e8, 895),
            PublishedScore(1.7e9, 900.5, 1119 * 64),
        ),
    ),
    demo=DemoPlan(
        bundle="tiny-int8",
        preset="dream",
        dream_minutes=0.5,
        minutes=4.0,
        temperature=1.5,
        population=24,
        episodes=4,
        horizon=1000,
        patience=100,
        able_score=800,
        quick_steps=700_000,
        # To drive on grass predicts losses that one track may not show.
        variant="offroad_cost=2",
        judge="gymnasium's environment",
        video_steps=1000,
    ),
)
