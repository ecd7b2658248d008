"""Take Cover, ViZDoom's: its presets, its published score and its demonstration. Pages: watch.md."""

from typing import Any

from dreamfleet.common.worlds.profile import DemoPlan, PublishedScore, PublishedScores, ShippedScore, WorldProfile

TASK = "takecover"
# 525 decisions of 4 tics are the game's limit of 2,100 tics.
LIMIT = 525
# In the dream. Long searches find what the dream alone allows, so each mean is looked at, and the confirmation chooses.
DREAM: dict[str, Any] = {
    "task": "dream",
    "bundle": "takecover",
    "population": 64,
    "episodes": 16,
    "sigma0": 0.1,
    "covariance": "diagonal",
    "horizon": LIMIT,
    "temperature": 1.15,
    "evaluate_every": 15,
    "evaluation_episodes": 100,
    "confirm_episodes": 100,
}
# In the game itself, by what the world model sees and remembers, from a controller of the dream (`--init`).
REAL: dict[str, Any] = {
    "task": TASK,
    "bundle": "takecover",
    "population": 24,
    "episodes": 4,
    "sigma0": 0.08,
    "covariance": "diagonal",
    "horizon": LIMIT,
    "evaluate_every": 10,
    "evaluation_episodes": 100,
    "confirm_episodes": 100,
}
# To survive is the reward, and its end the done head's. A fireball is a few pixels, whose errors count more.
TRAINING: dict[str, Any] = {
    "collect": {"episodes": 4000, "steps": LIMIT, "driver": "held", "anywhere": 0.0, "patience": 0},
    "vae": {"updates": 2500, "batch": 100, "rate": 1e-3},
    "mdnrnn": {"updates": 1200, "batch": 32, "rate": 1e-3},
    "vae_layers": {"channels": (16, 32, 64, 128), "pixel_weight": 3.0, "latent": 64},
    "mdnrnn_layers": {"latent": 64, "reward": "none", "done": True, "done_weight": 3.0},
}
PROFILE = WorldProfile(
    task=TASK,
    score_word="game",
    score_unit="tics survived",
    units_per_second=35,
    end_texts={"terminated": "hit after {score:,.0f} tics", "truncated": "survived to the limit, {score:,.0f} tics"},
    shipped_scores=(
        ShippedScore("2be53319395a", 786.1, 50.7, 100, 10055),  # takecover
        ShippedScore("35b4174dfc32", 979.9, 50.4, 100, 10070),  # takecover-real
    ),
    run_presets={"takecover": DREAM, "takecover-real": REAL},
    dream_preset="takecover",
    training_presets={"takecover": TRAINING},
    default_training="takecover",
    # The paper gives scores alone, of a tic a decision.
    published=PublishedScores(
        "Ha & Schmidhuber 2018, from dreams alone: 1092, standard deviation 556 (a decision every tic; their steps are "
        "unknown)",
        (PublishedScore(None, 1092),),
    ),
    demo=DemoPlan(
        bundle="takecover",
        preset="takecover",
        dream_minutes=3.0,
        minutes=1.5,
        temperature=1.15,
        population=24,
        episodes=4,
        horizon=LIMIT,
        patience=0,
        able_score=750,
        quick_steps=100_000,
        judge="the game, 4 tics a decision",
        # Games of one controller differ by 500 tics: fewer of them would judge by luck.
        tracks=100,
        dream_evaluations=(5, 50, 50),
        real_evaluations=(5, 50, 64),
        video_steps=LIMIT,
        random_score=366,
        packages=("vizdoom",),
    ),
)
