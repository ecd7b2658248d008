"""What each phase asks of the stages, and its coordinator's flags."""

from pathlib import Path

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.plan import Phase
from tests.support.ledgers import entry
from tests.support.phase_requests import requests

ROUND_2 = (entry(1, "collect", episodes=620), entry(1, "bundle"), entry(1, "evolve"))
DATA = Path("data")


def test_the_first_round_takes_the_presets_amounts():
    first = requests(vae_flags="--batch 50")
    collected, trained = first.collect(1), first.train(1, "vae")
    assert (collected.data, collected.preset, collected.settings) == (DATA, "tiny", {"seed": 0})
    assert (trained.data, trained.preset, trained.device) == (DATA / "rounds" / "01", "tiny", "cpu")
    assert (trained.settings, trained.continue_from) == ({"batch": 50, "seed": 0}, None)


def test_each_round_trains_and_evolves_by_chance_of_its_own_on_one_data_set():
    made = requests(seed=5)
    assert [made.seed(Phase(1, name)) for name in ("collect", "vae", "mdnrnn", "evolve")] == [5, 5, 5, 6]
    assert [made.seed(Phase(3, name)) for name in ("drive", "vae", "mdnrnn", "gate", "evolve")] == [5, 7, 7, 50_000, 8]
    assert made.train(3, "vae").settings["seed"] == 7


def test_later_rounds_add_drives_to_those_that_there_are():
    later = requests(*ROUND_2, more_drives=580, drive_steps=300, jobs=2)
    assert later.collect(2).settings == {"seed": 0, "episodes": 1200, "steps": 300}
    assert later.collect(2).jobs == 2
    drive = requests(*ROUND_2, own_drives=80, noise=0.2).drive([Path("0.npz"), Path("1.npz")])
    assert (drive.settings, drive.controllers) == ({"seed": 0, "episodes": 700, "noise": 0.2}, ("0.npz", "1.npz"))
    assert requests(*ROUND_2, spells=0.01).drive([Path("0.npz")]).settings["spells"] == 0.01
    kept = later.import_kept(2)
    assert (kept.data, kept.run, kept.runs_dir) == (DATA, "round-01", DATA / "runs")


@pytest.mark.parametrize(("vae", "decoder_only"), [("decoder", True), ("whole", False)])
def test_later_training_goes_on_from_the_model_that_counts(vae, decoder_only):
    later = requests(*ROUND_2, entry(2, "bundle"), entry(2, "gate", kept=False), vae=vae)
    trained = later.train(3, "vae")
    assert trained.settings == {"seed": 2, "updates": 1800}
    assert trained.continue_from == DATA / "rounds" / "01" / "vae.safetensors"
    assert (trained.decoder_only, later.train(3, "mdnrnn").decoder_only) == (decoder_only, False)


def test_flags_of_bundle_are_of_every_round():
    made = requests(*ROUND_2, bundle_flags="--reward value --end 0.3")
    for number in (1, 2):
        found = made.bundle(number)
        assert (found.out.name, found.reward, found.end) == (f"round-{number}.zip", "value", "0.3")
    with pytest.raises(UsageError, match="--out"):
        IterateConfig(bundle_flags="--out b.zip")


def test_updates_among_the_flags_of_every_round_count_in_later_rounds_too():
    made = requests(*ROUND_2, vae_flags="--updates 20", mdnrnn_flags="--updates 10", mdnrnn_updates=5)
    for model, updates in (("vae", [20, 20]), ("mdnrnn", [10, 5])):
        assert [made.train(number, model).settings["updates"] for number in (1, 2)] == updates


def test_with_init_the_first_round_goes_on_as_later_ones_do():
    made = requests(entry(0, "init", sha256="ab", controller="tiny"), init="tiny", vae="keep",
                    mdnrnn_flags="--set done=true")  # fmt: skip
    begun = DATA / "rounds" / "00"
    train = made.train(1, "mdnrnn")
    assert train.settings == {"seed": 0, "updates": 600, "done": True}
    assert train.continue_from == begun / "mdnrnn.safetensors"
    assert made.train(1, "vae").continue_from == begun / "vae.safetensors", "one that stays sees the drives too"
    assert made.drive([Path("0.npz")]).settings["episodes"] == 80
    refit = made.refit(1, Path("moved.npz"))
    assert (refit.controller, refit.to) == (str(begun / "controller.npz"), "data/rounds/01/round-1.zip")
    old = made.gate(1)["old"]["probe"]
    assert (old.subject, old.controller) == (str(begun / "bundle.zip"), str(begun / "controller.npz"))
    assert f"--bundle {begun / 'bundle.zip'}" in " ".join(made.run_flags(1)), "no gate has passed another"
    run = IterateConfig(init="tiny", run_flags="--generations 3", later_run_flags="--temperature 1")
    assert run.flags_of_run(1) == ("--generations", "3", "--temperature", "1")


def test_both_models_are_measured_on_the_same_drives_and_tracks():
    gate = requests(*ROUND_2, entry(2, "bundle")).gate(2)
    old, new = (gate[side]["probe"] for side in ("old", "new"))
    assert (old.subject, new.subject) == ("data/rounds/01/round-1.zip", "data/rounds/02/round-2.zip")
    assert old.controller == new.controller == gate["old"]["losses"].controller == "data/runs/round-01/controller.npz"
    assert old.figures == ("probe",)
    losses = gate["new"]["losses"]
    assert (losses.controller, losses.episodes, losses.seed) == ("data/rounds/02/moved.npz", 30, 50_000)
    refit = requests(*ROUND_2, entry(2, "bundle")).refit(2, Path("moved.npz"))
    assert (refit.controller, refit.to) == (old.controller, new.subject)
    assert (refit.data, refit.out) == (DATA, Path("moved.npz"))


def test_a_round_evolves_in_the_model_that_counts_with_a_seed_of_its_own():
    made = requests(*ROUND_2, entry(2, "bundle"), entry(2, "gate", kept=False), run_flags="--generations 3")
    few = Path("few.npz")
    assert " ".join(made.run_flags(2, Path("start.npz"), few)) == (
        "--generations 3 --bundle data/rounds/01/round-1.zip --seed 2 --init start.npz --subspace few.npz"
    )
    found = made.subspace(2, few)
    assert (found.bundle, found.out, found.views) == ("data/rounds/01/round-1.zip", few, 0)
    assert requests(*ROUND_2, views=8, subspace=True, go_on=True).subspace(2, few).views == 8


def test_later_rounds_may_evolve_otherwise_than_the_first():
    made = requests(*ROUND_2, run_flags="--generations 32", later_run_flags="--generations 6 --temperature 1")
    first, later = (" ".join(made.run_flags(number)) for number in (1, 2))
    assert first.startswith("--generations 32 --bundle")
    assert later.startswith("--generations 32 --generations 6 --temperature 1 --bundle")


@pytest.mark.parametrize("flags", ["--data elsewhere", "--updates 3 --seed=9", "--continue other.safetensors", "--new"])
def test_flags_that_the_iteration_sets_itself_are_refused(flags):
    with pytest.raises(UsageError, match="--vae-flags"):
        IterateConfig(vae_flags=flags)
    assert IterateConfig(run_flags=flags)


def test_the_world_of_the_data_is_of_collecting_and_names_the_preset():
    made = requests(task="gym:ALE/Pong-v5", environment=("mode=1",), crop="0:160,0:160", skip=4, difference=True)
    found = made.collect(1)
    assert (found.preset, found.task) == ("pixels", "gym:ALE/Pong-v5")
    assert found.world == {"environment": {"mode": 1}, "crop": "0:160,0:160", "skip": 4, "difference": True}
    assert requests().collect(1).world == {}
    assert requests(task="takecover").train(1, "mdnrnn").preset == "takecover"
    assert requests(task="takecover", preset="tiny").collect(1).preset == "tiny"


def test_a_gate_of_other_worlds_measures_survival_too():
    gate = requests(*ROUND_2, entry(2, "bundle"), task="takecover", gate_drives=0, gate_losses=0).gate(2)
    found = gate["new"]["survival"]
    assert (found.subject, found.controller, found.episodes) == ("data/rounds/02/round-2.zip", None, 40)
    assert (found.figures, found.seed) == (("survival",), 50_000)
    assert gate["old"].keys() == {"survival"}
    assert "survival" not in requests(*ROUND_2, entry(2, "bundle")).gate(2)["old"]
    assert requests(*ROUND_2, entry(2, "bundle"), gate_lives=9).config.survival_episodes == 9
