"""The verbs of each phase, as words."""

from pathlib import Path

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.plan import Phase
from tests.support.ledgers import entry
from tests.support.phase_commands import commands

ROUND_2 = (entry(1, "collect", episodes=620), entry(1, "bundle"), entry(1, "evolve"))


def said(words):
    return " ".join(words)


def test_the_first_round_takes_the_presets_amounts():
    first = commands(vae_flags="--batch 50")
    assert said(first.collect(1)) == "collect --data data --preset tiny --seed 0 --json"
    assert said(first.train(1, "vae")) == (
        "train vae --data data/rounds/01 --preset tiny --device cpu --seed 0 --json --batch 50"
    )
    assert said(first.check_training("vae")) == said(first.train(1, "vae")) + " --summary"


def test_each_round_trains_and_evolves_by_chance_of_its_own_on_one_data_set():
    made = commands(seed=5)
    assert [made.seed(Phase(1, name)) for name in ("collect", "vae", "mdnrnn", "evolve")] == [5, 5, 5, 6]
    assert [made.seed(Phase(3, name)) for name in ("drive", "vae", "mdnrnn", "gate", "evolve")] == [5, 7, 7, 50_000, 8]


def test_later_rounds_add_drives_to_those_that_there_are():
    later = commands(*ROUND_2, more_drives=580, drive_steps=300, jobs=2)
    assert "--episodes 1200 --steps 300 --jobs 2" in said(later.collect(2))
    drive = said(commands(*ROUND_2, own_drives=80, noise=0.2).drive([Path("0.npz"), Path("1.npz")]))
    assert drive.endswith("--episodes 700 --noise 0.2 --controller 0.npz 1.npz --json")
    tried = said(commands(*ROUND_2, spells=0.01).drive([Path("0.npz")]))
    assert "--noise 0.3 --spells 0.01 --controller 0.npz" in tried
    assert said(later.import_kept(2)) == "collect --data data --from-run round-01 --runs-dir data/runs --json"


@pytest.mark.parametrize(("vae", "decoder_only"), [("decoder", True), ("whole", False)])
def test_later_training_goes_on_from_the_model_that_counts(vae, decoder_only):
    later = commands(*ROUND_2, entry(2, "bundle"), entry(2, "gate", kept=False), vae=vae)
    words = later.train(3, "vae")
    assert "--seed 2" in said(words)
    assert "--updates 1800 --continue-from data/rounds/01/vae.safetensors" in said(words)
    assert ("--decoder-only" in words) == decoder_only
    assert "--decoder-only" not in later.train(3, "mdnrnn")


def test_flags_of_bundle_are_of_every_round():
    made = commands(*ROUND_2, bundle_flags="--reward value --end 0.3")
    ends = [
        said(made.bundle(number)).endswith(f"round-{number}.zip --json --reward value --end 0.3") for number in (1, 2)
    ]
    assert ends == [True, True]
    with pytest.raises(UsageError, match="--bundle-flags: omit --out, which iterate sets itself"):
        IterateConfig(bundle_flags="--out b.zip")


def test_updates_among_the_flags_of_every_round_count_in_later_rounds_too():
    made = commands(*ROUND_2, vae_flags="--updates 20", mdnrnn_flags="--updates 10", mdnrnn_updates=5)
    assert said(made.train(1, "vae")).endswith("--updates 20")
    assert "--updates 20 --continue-from" in said(made.train(2, "vae"))
    assert said(made.train(1, "mdnrnn")).endswith("--updates 10")
    assert "--updates 5 --continue-from" in said(made.train(2, "mdnrnn")), "what is said of later rounds alone"


def test_with_init_the_first_round_goes_on_as_later_ones_do():
    made = commands(entry(0, "init", sha256="ab", controller="tiny"), init="tiny", vae="keep", mdnrnn_flags="--done")
    assert said(made.unbundle()) == "bundle --extract data/rounds/00/bundle.zip --data data/rounds/00 --json"
    train = said(made.train(1, "mdnrnn"))
    assert "--seed 0 --json --updates 600 --set done=true --continue-from data/rounds/00/mdnrnn.safetensors" in train
    vae, mdnrnn = (said(words) for words in made.check_trainings())
    assert mdnrnn == f"{train} --summary"
    assert "--continue-from data/rounds/00/vae.safetensors --summary" in vae, "one that stays sees the drives too"
    assert "--episodes 80" in said(made.drive([Path("0.npz")]))
    assert said(made.refit(1, Path("moved.npz"))).startswith(
        "lab refit data/rounds/00/controller.npz --to data/rounds/01/"
    )
    old = said(made.gate(1)["old"]["probe"])
    assert old.startswith("inspect data/rounds/00/bundle.zip --probe --controller data/rounds/00/controller.npz")
    assert "--bundle data/rounds/00/bundle.zip" in said(made.begin_run(1, (), ())), "no gate has passed another"
    run = IterateConfig(init="tiny", run_flags="--generations 3", later_run_flags="--temperature 1")
    assert run.flags_of_run(1) == ("--generations", "3", "--temperature", "1")


def test_both_models_are_measured_on_the_same_drives_and_tracks():
    gate = commands(*ROUND_2, entry(2, "bundle")).gate(2)
    old, new = (said(gate[side]["probe"]) for side in ("old", "new"))
    assert old.startswith("inspect data/rounds/01/round-1.zip --probe --controller data/runs/round-01/controller.npz")
    assert new == old.replace("rounds/01/round-1", "rounds/02/round-2")
    assert "--controller data/rounds/02/moved.npz --episodes 30 --seed 50000" in said(gate["new"]["losses"])
    assert "--controller data/runs/round-01/controller.npz" in said(gate["old"]["losses"])


def test_the_optimum_is_fitted_to_the_new_model_by_all_drives():
    words = said(commands(*ROUND_2, entry(2, "bundle")).refit(2, Path("moved.npz")))
    assert words == (
        "lab refit data/runs/round-01/controller.npz --to data/rounds/02/round-2.zip --data data --out moved.npz --json"
    )


def test_a_round_evolves_in_the_model_that_counts_with_a_seed_of_its_own():
    refused = commands(
        *ROUND_2, entry(2, "bundle"), entry(2, "gate", kept=False), run_flags="--generations 3 --recorded 0.5"
    )
    words = said(refused.begin_run(2, ("tcp/127.0.0.1:7000",), ("--preset", "dream"), Path("start.npz")))
    assert words == (
        "coordinator --preset dream --generations 3 --recorded 0.5 --run round-02 "
        "--bundle data/rounds/01/round-1.zip --seed 2 --init start.npz "
        "--runs-dir data/runs --json --listen tcp/127.0.0.1:7000"
    )
    assert said(refused.resume_run(2, ("tcp/127.0.0.1:7000",))) == (
        "coordinator --resume round-02 --runs-dir data/runs --json --listen tcp/127.0.0.1:7000"
    )


def test_an_evolution_in_a_subspace_names_its_file():
    made = commands(*ROUND_2, entry(2, "bundle"), entry(2, "gate", kept=False), run_flags="--generations 3")
    few = Path("few.npz")
    words = said(made.subspace(2, few))
    assert words == "lab subspace data/rounds/01/round-1.zip --data data --out few.npz --json", (
        "of the model that counts"
    )
    assert "--init start.npz --subspace few.npz" in said(made.begin_run(2, (), (), Path("start.npz"), few))
    seeing = commands(*ROUND_2, views=8, subspace=True, go_on=True)
    assert "--data data --views 8 --out" in said(seeing.subspace(2, few))


def test_later_rounds_may_evolve_otherwise_than_the_first():
    made = commands(*ROUND_2, run_flags="--generations 32", later_run_flags="--generations 6 --temperature 1")
    first, later = (said(made.begin_run(number, (), (), None)) for number in (1, 2))
    assert first.startswith("coordinator --generations 32 --run round-01")
    assert later.startswith("coordinator --generations 32 --generations 6 --temperature 1 --run round-02")


@pytest.mark.parametrize("flags", ["--data elsewhere", "--updates 3 --seed=9", "--continue other.safetensors", "--new"])
def test_flags_that_the_iteration_sets_itself_are_refused(flags):
    with pytest.raises(UsageError, match="which iterate sets itself"):
        IterateConfig(vae_flags=flags)
    assert IterateConfig(run_flags=flags)


def test_the_world_of_the_data_is_passed_to_collect_alone_and_names_the_preset():
    made = commands(task="gym:ALE/Pong-v5", environment=("mode=1",), crop="0:160,0:160", skip=4, difference=True)
    assert said(made.collect(1)) == (
        "collect --data data --preset pixels --seed 0 --task gym:ALE/Pong-v5 --environment mode=1 "
        "--crop 0:160,0:160 --skip 4 --difference --json"
    )
    others = (made.train(1, "vae"), made.encode(1), made.bundle(1), made.import_kept(2), made.begin_run(1, (), ()))
    assert not any("gym:ALE/Pong-v5" in words for words in others)
    assert "--preset takecover" in said(commands(task="takecover").train(1, "mdnrnn"))
    assert "--preset tiny" in said(commands(task="takecover", preset="tiny").collect(1))


def test_a_gate_of_other_worlds_measures_survival_too():
    gate = commands(*ROUND_2, entry(2, "bundle"), task="takecover", gate_drives=0, gate_losses=0).gate(2)
    assert said(gate["new"]["survival"]) == (
        "inspect data/rounds/02/round-2.zip --survival --episodes 40 --seed 50000 --json"
    )
    assert gate["old"].keys() == {"survival"}
    assert "survival" not in commands(*ROUND_2, entry(2, "bundle")).gate(2)["old"]
    assert commands(*ROUND_2, entry(2, "bundle"), gate_lives=9).config.survival_episodes == 9
