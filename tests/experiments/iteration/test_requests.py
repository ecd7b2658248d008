"""What each phase asks of the stages, and its flags. Tests dreamfleet/experiments/local/command_lines.py."""

from pathlib import Path

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.plan import Phase
from tests.support.ledgers import entry, requests

ROUND_2 = (entry(1, "collect", episodes=620), entry(1, "bundle"), entry(1, "evolve"))
GATED = (*ROUND_2, entry(2, "bundle"))
REFUSED = (*GATED, entry(2, "gate", kept=False))
DATA, BEGUN = Path("data"), Path("data/rounds/00")
FEW, MOVED, DRIVERS = Path("few.npz"), Path("moved.npz"), [Path("0.npz"), Path("1.npz")]
FIRST_BUNDLE, SECOND_BUNDLE = "data/rounds/01/round-1.zip", "data/rounds/02/round-2.zip"
FIRST_BEST = "data/runs/round-01/controller.npz"
INIT = requests(
    entry(0, "init", sha256="ab", controller="tiny"), init="tiny", vae="keep", mdnrnn_flags="--set done=true"
)
WITH_FLAGS = requests(*ROUND_2, bundle_flags="--reward value --end 0.3")
UPDATES = requests(*ROUND_2, vae_flags="--updates 20", mdnrnn_flags="--updates 10", mdnrnn_updates=5)
PONG = {"task": "gym:ALE/Pong-v5", "environment": ("mode=1",), "crop": "0:160,0:160", "skip": 4, "difference": True}
GATE = requests(*GATED).gate(2)
LIVES = requests(*GATED, task="takecover", gate_drives=0, gate_losses=0).gate(2)
# Sentences that say why, what is asked, and what it must name.
ASKED = [
    ("the first round takes the preset's amounts", requests().collect(1),
     {"data": DATA, "preset": "tiny", "settings": {"seed": 0}, "world": {}}),
    ("and its flags", requests(vae_flags="--batch 50").train(1, "vae"),
     {"data": DATA / "rounds/01", "preset": "tiny", "device": "cpu", "settings": {"batch": 50, "seed": 0},
      "continue_from": None}),
    ("later rounds add random drives", requests(*ROUND_2, more_drives=580, drive_steps=300, jobs=2).collect(2),
     {"settings": {"seed": 0, "episodes": 1200, "steps": 300}, "jobs": 2}),
    ("and own ones", requests(*ROUND_2, own_drives=80, noise=0.2, spells=0.01).drive(DRIVERS),
     {"settings": {"seed": 0, "episodes": 700, "noise": 0.2, "spells": 0.01}, "controllers": ("0.npz", "1.npz")}),
    ("and kept ones", requests(*ROUND_2).import_kept(2), {"data": DATA, "run": "round-01", "runs_dir": DATA / "runs"}),
    *((f"training goes on from the model that counts: {vae}", requests(*REFUSED, vae=vae).train(3, "vae"),
       {"settings": {"seed": 2, "updates": 1800}, "continue_from": DATA / "rounds/01/vae.safetensors",
        "decoder_only": vae == "decoder"}) for vae in ("decoder", "whole")),
    ("an MDN-RNN has no decoder", requests(*REFUSED, vae="decoder").train(3, "mdnrnn"), {"decoder_only": False}),
    *((f"flags of bundle are of round {number} too", WITH_FLAGS.bundle(number),
       {"out": DATA / f"rounds/0{number}/round-{number}.zip", "reward": "value", "end": "0.3"}) for number in (1, 2)),
    *((f"so many updates among all rounds' flags count in round {number} too", UPDATES.train(number, model),
       {"settings": {"seed": number - 1, "updates": updates}})
      for model, both in (("vae", [20, 20]), ("mdnrnn", [10, 5])) for number, updates in enumerate(both, 1)),
    ("with init the first round goes on as later ones do", INIT.train(1, "mdnrnn"),
     {"settings": {"seed": 0, "updates": 600, "done": True}, "continue_from": BEGUN / "mdnrnn.safetensors"}),
    ("a VAE that stays sees the drives too", INIT.train(1, "vae"), {"continue_from": BEGUN / "vae.safetensors"}),
    ("with init the first round drives", INIT.drive(DRIVERS[:1]),
     {"settings": {"seed": 0, "episodes": 80, "noise": 0.3}}),
    ("and moves its controller", INIT.refit(1, MOVED),
     {"controller": str(BEGUN / "controller.npz"), "to": FIRST_BUNDLE}),
    ("and its model is measured", INIT.gate(1)["old"]["probe"],
     {"subject": str(BEGUN / "bundle.zip"), "controller": str(BEGUN / "controller.npz")}),
    ("the old model is measured on the old best's drives", GATE["old"]["probe"],
     {"subject": FIRST_BUNDLE, "controller": FIRST_BEST, "figures": ("probe",)}),
    ("the new model on the same", GATE["new"]["probe"], {"subject": SECOND_BUNDLE, "controller": FIRST_BEST}),
    ("its losses too", GATE["old"]["losses"], {"controller": FIRST_BEST}),
    ("the new one's by a moved controller", GATE["new"]["losses"],
     {"controller": "data/rounds/02/moved.npz", "episodes": 30, "seed": 50_000}),
    ("which is this one", requests(*GATED).refit(2, MOVED),
     {"controller": FIRST_BEST, "to": SECOND_BUNDLE, "data": DATA, "out": MOVED}),
    ("a subspace is of the model that counts", requests(*REFUSED).subspace(2, FEW),
     {"bundle": FIRST_BUNDLE, "out": FEW, "views": 0}),
    ("and perhaps of views", requests(*ROUND_2, views=8, subspace=True, go_on=True).subspace(2, FEW), {"views": 8}),
    ("the world is of collecting and names the preset", requests(**PONG).collect(1),
     {"preset": "pixels", "task": PONG["task"], "world":
      {"environment": {"mode": 1}, "crop": "0:160,0:160", "skip": 4, "difference": True}}),
    ("training too", requests(task="takecover").train(1, "mdnrnn"), {"preset": "takecover"}),
    ("unless one is named", requests(task="takecover", preset="tiny").collect(1), {"preset": "tiny"}),
    ("a gate of other worlds measures survival", LIVES["new"]["survival"],
     {"subject": SECOND_BUNDLE, "controller": None, "episodes": 40, "figures": ("survival",), "seed": 50_000}),
]  # fmt: skip


@pytest.mark.parametrize(("asked", "fields"), [each[1:] for each in ASKED], ids=[each[0] for each in ASKED])
def test_a_phase_asks_for_its_stage(asked, fields):
    assert {name: getattr(asked, name) for name in fields} == fields


def test_each_round_trains_and_evolves_by_chance_of_its_own_on_one_data_set():
    made = requests(seed=5)
    assert [made.seed(Phase(1, name)) for name in ("collect", "vae", "mdnrnn", "evolve")] == [5, 5, 5, 6]
    assert [made.seed(Phase(3, name)) for name in ("drive", "vae", "mdnrnn", "gate", "evolve")] == [5, 7, 7, 50_000, 8]
    assert made.train(3, "vae").settings["seed"] == 7


def test_a_round_evolves_in_the_model_that_counts_with_flags_of_its_own():
    made = requests(*REFUSED, run_flags="--generations 3")
    assert " ".join(made.run_flags(2, Path("start.npz"), FEW)) == (
        f"--generations 3 --bundle {FIRST_BUNDLE} --seed 2 --init start.npz --subspace few.npz"
    )
    assert f"--bundle {BEGUN / 'bundle.zip'}" in " ".join(INIT.run_flags(1)), "no gate has passed another"
    made = requests(*ROUND_2, run_flags="--generations 32", later_run_flags="--generations 6 --temperature 1")
    first, later = (" ".join(made.run_flags(number)) for number in (1, 2))
    assert first.startswith("--generations 32 --bundle")
    assert later.startswith("--generations 32 --generations 6 --temperature 1 --bundle")
    run = IterateConfig(init="tiny", run_flags="--generations 3", later_run_flags="--temperature 1")
    assert run.flags_of_run(1) == ("--generations", "3", "--temperature", "1")


@pytest.mark.parametrize(
    "flags", ["--data elsewhere", "--updates 3 --seed=9", "--see=3", "--x --seed", "--continue other", "--new"]
)
def test_flags_that_the_iteration_sets_itself_are_refused(flags):
    with pytest.raises(UsageError, match="--vae-flags"):
        IterateConfig(vae_flags=flags)
    with pytest.raises(UsageError, match="--out"):
        IterateConfig(bundle_flags="--out b.zip")
    assert IterateConfig(run_flags=flags)


def test_survival_is_measured_alone_and_not_of_the_first_world():
    assert LIVES["old"].keys() == {"survival"}
    assert "survival" not in GATE["old"]
    assert requests(*GATED, gate_lives=9).config.survival_episodes == 9
