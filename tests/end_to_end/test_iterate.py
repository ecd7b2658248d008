"""Two rounds of world models and evolutions, seconds long each, and two kinds of MDN-RNNs, left alone and killed.
Tests dreamfleet/experiments/iteration/runner.py, dreamfleet/experiments/verbs/iterate.py,
dreamfleet/experiments/contrast/trials.py and dreamfleet/experiments/verbs/contrast.py."""

import json
import os
import re
import shutil
import signal
import time

import numpy as np
import psutil
import pytest

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.artifacts.car_racing_variants import Variant
from dreamfleet.common.artifacts.controller import Controller
from dreamfleet.common.artifacts.subspace import Subspace
from dreamfleet.common.host.stop_signals import never_stop
from dreamfleet.common.runs.run_folder import open_run
from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.layout import IterationFolder
from dreamfleet.experiments.iteration.ledger import FinishedPhase, IterationLedger
from dreamfleet.experiments.iteration.phases import PhaseRunner
from dreamfleet.experiments.iteration.plan import Phase
from dreamfleet.experiments.iteration.requests import Requests
from dreamfleet.worker.worldmodel.mdnrnn_config import MDNRNNConfig
from dreamfleet.worker.worldmodel.vae_config import VAEConfig
from tests.support.bundles import write_random_bundle
from tests.support.drives import write_drive, write_drives, write_encoded_drives
from tests.support.processes import call_here, processes_in, refused, until
from tests.support.tables import cells
from tests.support.variants import controller_of

pytestmark = pytest.mark.slow
EYES = VAEConfig(latent=4, channels=(2, 2, 2, 2))
RUN = (
    "--generations 2 --population 4 --episodes 1 --horizon 10 --evaluate-every 1 --evaluation-episodes 1"
    " --confirm-episodes 0"
)
SMALL = (
    "--rounds", 2, "--drives", 3, "--drive-steps", 12, "--own-drives", 2, "--means", 2, "--jobs", 1, "--local", 1,
    "--vae-flags", "--updates 3 --batch 8 --set latent=4 channels=2,2,2,2 validate_every=1", "--vae-updates", 2,
    "--mdnrnn-flags", "--updates 3 --batch 2 --set latent=4 hidden=4 validate_every=1", "--mdnrnn-updates", 2,
    "--run-flags", f"{RUN} --collect-every 2 --collect-episodes 1",
    "--gate-drives", 2, "--gate-losses", 0,
)  # fmt: skip
FIRST = ("collect", "vae", "encode", "mdnrnn", "bundle", "evolve")
SECOND = ("take", "drive", "vae", "encode", "mdnrnn", "bundle", "gate", "evolve")
PHASES = [*(Phase(1, name) for name in FIRST), *(Phase(2, name) for name in SECOND)]


def words(folder, *more):
    return ("iterate", "--data", folder, *SMALL, *more)


def until_exists(path, process):
    """Wait for a file; a process that ends meanwhile ends the waiting."""
    while not path.exists():
        assert process.popen.poll() is None, process.lines
        time.sleep(0.01)  # it works on this core too


def hashes(layout):
    """Of all that follows from the settings. A run's files name it, a checkpoint's head has its words in any order."""
    made = [each for entry in IterationLedger.load(layout.ledger).entries for each in entry.made]
    return {
        each.path: each.sha256 for each in made if not each.path.startswith("runs/") and "safetensors" not in each.path
    }


def left(folder):
    """Command lines of processes that work in the folder."""
    lines = (
        " ".join(each.info["cmdline"] or ()) for each in psutil.process_iter(["cmdline"]) if each.pid != os.getpid()
    )
    return [line for line in lines if str(folder) in line]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The folder of an iteration that nobody disturbed, and what it answered; read only."""
    with processes_in(tmp_path_factory.mktemp("iterate")) as processes:
        layout = IterationFolder(processes.folder / "data")
        code, out, err = processes.call(*words(layout.root, "--json"))
        assert code == 0, err
        yield layout, json.loads(out), err


def test_each_round_makes_a_model_from_all_drives_and_evolves_in_its_dream(undisturbed):
    layout, answer, err = undisturbed
    ledger = IterationLedger.load(layout.ledger)
    assert list(ledger.finished) == PHASES
    assert [each["drives"] for each in answer["rounds"]] == [3, 6]
    for number in (1, 2):
        bundle = Bundle.open(layout.bundle(number))
        assert bundle.manifest.provenance["episodes"] == 3 * number
        assert bundle.sha256 == answer["rounds"][number - 1]["sha256"]
        assert {"reconstruction_error", "nats_per_dimension"} <= bundle.manifest.provenance["quality"].keys()
        with open_run(layout.runs, layout.run_name(number)) as run:
            assert run.spec.task == "dream"
            assert run.spec.bundle == Bundle.open(layout.bundle(ledger.model_round(number))).sha256
            assert run.settings.seed == number
            assert answer["rounds"][number - 1]["score"]["mean"] == max(each.mean for each in run.evaluations())
    lines = [line for line in err.splitlines() if line.startswith("round ")]
    assert [tuple(line.split()[1:3]) for line in lines] == [(str(number), name) for number, name in PHASES]


def test_the_encoder_stays_and_what_evolved_drives_for_the_next_model(undisturbed):
    layout, _, _ = undisturbed
    one, two = (Bundle.open(layout.bundle(number)) for number in (1, 2))
    assert one.read("encoder.onnx") == two.read("encoder.onnx")
    assert one.read("decoder.onnx") != two.read("decoder.onnx")
    assert one.read("dream.onnx") != two.read("dream.onnx")
    with open_run(layout.runs, "round-01") as run:
        reported = Controller.load(run.controller_path)
        other = next(each for each in (0, 1) if each != reported.provenance["generation"])
        vectors = [reported.parameters, run.evaluated_mean(other)]
    for row, vector in enumerate(vectors):
        pilot = Controller.load(layout.means(1) / f"{row}.npz")
        assert (pilot.parameters == vector).all()
        assert pilot.bundle == one.sha256
    ledger = IterationLedger.load(layout.ledger)
    (asked,) = ledger.entry(2, "drive").requests
    assert asked["settings"]["noise"] == 0.3
    assert asked["controllers"] == [str(layout.means(1) / f"{row}.npz") for row in range(2)]
    assert ledger.entry(2, "gate").figures["kept"], "a gate that can measure nothing refuses nothing"
    answer = json.loads(layout.gate_file(2).read_text())
    assert answer["old"] == answer["new"]
    assert answer["new"]["probe"]["failed"]


def gate(layout, new, drives=write_drives, **changes):
    """The figures of a gate that holds the bundle `new` to `tiny`."""
    tiny = find_bundle("tiny").path
    places = {layout.bundle(1): tiny, layout.bundle(2): new, layout.run(1) / "bundle.zip": tiny}
    for place, source in {**places, layout.run(1) / "controller.npz": tiny.with_suffix(".npz")}.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, place)
    drives(layout.root)
    config = IterateConfig(**changes)
    ledger = IterationLedger.begin(config, {})
    for number in (1, 2):
        ledger = ledger.add(FinishedPhase(number, "bundle", 0, 0.0, ""))
    phases = PhaseRunner(Requests(config, layout, ledger), None, never_stop, print)
    return phases.do(Phase(2, "gate")).figures


def ignorant(folder):
    small = {"vae": VAEConfig(latent=2, channels=(2, 2, 2, 2)), "rnn": MDNRNNConfig(latent=2, hidden=2)}
    return write_random_bundle(folder / "ignorant.zip", **small).path


def test_a_model_that_knows_clearly_less_is_refused(tmp_path):
    figures = gate(IterationFolder(tmp_path / "data"), ignorant(tmp_path), gate_drives=3, gate_losses=0)
    assert not figures["kept"]
    assert figures["old"]["knows"]["value"] > 0.4 > figures["new"]["knows"]["value"]
    assert figures["why"].endswith(" knows")


def test_a_driver_that_cannot_be_fitted_leaves_losses_unmeasured(tmp_path):
    layout = IterationFolder(tmp_path / "data")
    figures = gate(layout, ignorant(tmp_path), drives=lost_drives, gate_drives=0, gate_losses=4)
    assert figures["kept"]
    assert " 2 " in layout.gate_file(2).read_text(), "how many drives it has, none of which stays on its road"
    assert not layout.refitted(2).exists()


def lost_drives(folder):
    for number in range(2):
        write_drive(folder, number, reward=np.full(12, -0.1, np.float32))


def test_the_same_model_loses_the_road_as_often_on_the_same_drives(tmp_path):
    layout = IterationFolder(tmp_path / "data")
    figures = gate(layout, find_bundle("tiny").path, gate_drives=0, gate_losses=4)
    assert figures["kept"]
    assert Controller.load(layout.refitted(2)).bundle == find_bundle("tiny").sha256
    assert figures["new"] == figures["old"]
    assert abs(figures["old"]["loses"]["value"]) <= 1


def test_what_is_finished_is_not_done_again_and_other_settings_are_refused(undisturbed):
    layout, answer, _ = undisturbed
    before = layout.ledger.read_bytes()
    code, out, err = call_here("iterate", "--data", layout.root)
    assert (code, " 14 phases" in err) == (0, True), err
    assert cells(out.splitlines()[0])[:3] == ["round", "drives", "frames"]
    assert answer["model"] in out
    assert layout.ledger.read_bytes() == before
    for flags, said in (
        (("--noise", 0.5), "noise 0.3, not 0.5"),
        (("--run-flags", "--generations 3"), "generations 2, not 3"),
        (("--redo", "3/vae"), "3/vae"),
    ):
        refused(said, "iterate", "--data", layout.root, *flags)
    assert layout.ledger.read_bytes() == before


@pytest.mark.long
def test_a_later_round_searches_what_its_model_foretells(processes):
    layout = IterationFolder(processes.folder / "data")
    flags = ("--go-on", "--subspace", "--drive-steps", 150, "--own-drives", 6, "--drives", 6, "--gate-drives", 0)
    processes.printed(*words(layout.root, "--noise", 1, *flags))
    with open_run(layout.runs, layout.run_name(1)) as run:
        assert not run.settings.subspace
    with open_run(layout.runs, layout.run_name(2)) as run:
        found = Subspace.load(layout.subspace(2)) if layout.subspace(2).exists() else None
        assert run.settings.subspace == (found.sha256 if found else "")
        assert str(layout.start(2)) in run.fact("start")


@pytest.fixture(scope="module")
def pilot(tmp_path_factory):
    """A controller beside its world model, which nobody trained."""
    folder = tmp_path_factory.mktemp("pilot")
    bundle = write_random_bundle(folder / "bundle.zip", 5, EYES, MDNRNNConfig(latent=4, hidden=4))
    shape = bundle.controller_shape
    parameters = np.random.default_rng(5).normal(size=shape.size).astype(np.float32)
    Controller(shape, parameters, "car-racing", bundle.sha256).save(folder / "pilot.npz")
    return folder / "pilot.npz"


@pytest.mark.long
def test_an_iteration_goes_on_from_a_controller_and_its_world_model(processes, pilot):
    layout = IterationFolder(processes.folder / "data")
    flags = ("--rounds", 1, "--init", pilot, "--vae", "keep", "--go-on")
    mdnrnn = "--updates 3 --batch 2 --set latent=4 hidden=4 validate_every=1 done=true lost=4"
    out = processes.printed(*words(layout.root, *flags, "--mdnrnn-flags", mdnrnn, "--json"))
    ledger, begun = IterationLedger.load(layout.ledger), Bundle.open(pilot.with_name("bundle.zip"))
    first = ("collect", "drive", "vae", "encode", "mdnrnn", "bundle", "gate", "evolve")
    assert list(ledger.finished) == [Phase(0, "init"), *(Phase(1, name) for name in first)]
    assert Controller.load(layout.optimum(0)).sha256 == Controller.load(pilot).sha256
    made = Bundle.open(layout.bundle(1))
    assert made.read("encoder.onnx") == begun.read("encoder.onnx")
    assert made.manifest.models["mdnrnn"]["lost"] == 4
    assert made.manifest.provenance["episodes"] == 5, "random drives, and the controller's own"
    with open_run(layout.runs, layout.run_name(1)) as run:
        assert str(layout.start(1)) in run.fact("start")
    assert json.loads(out)["model"] == str(layout.bundle(ledger.model_round(1)))

    away = pilot.rename(pilot.with_name("away.npz"))
    processes.refused(str(pilot), "iterate", "--data", layout.root, "--redo", "0/init", code=1)
    assert layout.bundle(1).exists(), "nothing goes before it is known to be there"
    away.rename(pilot)
    processes.printed("iterate", "--data", layout.root, "--redo", "0/init", "--rounds", 1)
    assert hashes(layout)["rounds/01/round-1.zip"] == made.sha256


def test_until_it_has_what_it_goes_on_from_flags_may_be_mended(pilot, tmp_path):
    root = tmp_path / "data"
    wrong = ("--mdnrnn-flags", "--set latent=4 hidden=5", "--vae-flags", "--set latent=4 channels=2,2,2,2")
    refused("hidden 4, not 5", "iterate", "--data", root, "--init", pilot, *wrong, code=1)
    refused("nonsense", "iterate", "--data", root, "--mdnrnn-flags", "--set latent=4 hidden=4 nonsense=3")
    inside = root / "pilot.npz"
    for name in ("pilot.npz", "bundle.zip"):
        shutil.copyfile(pilot.with_name(name), root / name)
    refused(str(inside), "iterate", "--data", root, "--init", inside)


def test_a_controller_that_cannot_be_fitted_is_refused_at_once(pilot, tmp_path):
    bundle = Bundle.open(pilot.with_name("bundle.zip")).with_controllers(None, Variant(feedback="last"))
    (tmp_path / "bundle.zip").write_bytes(pilot.with_name("bundle.zip").read_bytes())
    controller_of(bundle).save(tmp_path / "seeing.npz")
    flags = ("--init", tmp_path / "seeing.npz", "--go-on")
    refused("--go-on", "iterate", "--data", tmp_path / "data", *flags)


@pytest.mark.parametrize(
    ("code", "flags", "said"),
    [
        (1, ("--init", "absent.npz"), "'absent.npz'"),
        (1, ("--init", "tiny", "--go-on", "--run-flags", "--generations 1 --features z"), "867"),
        (1, ("--init", "tiny", "--mdnrnn-flags", "--set hidden=8"), "0/init.* hidden 256, not 8"),
        (1, ("--init", "tiny", "--preset", "article", "--vae", "whole"), "0/init.* channels"),
        (2, ("--run-flags", "--population 4"), "--generations"),
        (2, ("--run-flags", "--generations 1 --bundle tiny"), "--bundle"),
        (2, ("--run-flags", "--generations 1 --sigma0 -1"), "--sigma0"),
        (2, ("--vae-flags", "--updates 0"), "--vae-flags"),
        (2, ("--bundle-flags", "--reward luck"), "'luck'"),
        (2, ("--bundle-flags", "--end 7"), "7.0"),
        (2, ("--vae-flags", "--set error_factor=4", "--mdnrnn-flags", "--set z_factor=0"), "--mdnrnn-flags"),
        (2, ("--local", 0), "--listen"),
        (2, ("--go-on", "--run-flags", "--generations 1 --variant feedback=last"), "--go-on"),
        (2, ("--subspace",), "--go-on"),
        (2, ("--views", 8), "--subspace"),
        (2, ("--run-flags", "--generations 1 --subspace few.npz"), "--subspace"),
    ],
)
def test_what_could_not_work_is_refused_before_anything_is_driven(tmp_path, code, flags, said):
    found, _, err = call_here("iterate", "--data", tmp_path / "data", *flags)
    assert (found, bool(re.search(said, err.replace("\n", " ")))) == (code, True), err
    assert not list((tmp_path / "data").glob("episodes/*.npz"))


def kill(process, layout):
    """At once; nothing of it works on."""
    process.popen.send_signal(signal.SIGKILL)
    process.popen.wait()
    until(lambda: not left(layout.root))


# What is there once a phase is under way.
BEGUN = {
    Phase(1, "collect"): "episodes/000000.npz", Phase(1, "vae"): "rounds/01/vae.safetensors",
    Phase(1, "encode"): "encoded/000000.npz", Phase(1, "mdnrnn"): "rounds/01/mdnrnn.safetensors",
    Phase(1, "bundle"): "rounds/01", Phase(1, "evolve"): "runs/round-01/journal.sqlite",
    Phase(2, "take"): "rounds/02", Phase(2, "drive"): "episodes/000004.npz",
    Phase(2, "vae"): "rounds/02/vae.safetensors", Phase(2, "encode"): "encoded/000003.npz",
    Phase(2, "mdnrnn"): "rounds/02/mdnrnn.safetensors", Phase(2, "bundle"): "rounds/02/logs/mdnrnn.log",
    Phase(2, "gate"): "rounds/02/logs/bundle.log", Phase(2, "evolve"): "runs/round-02/journal.sqlite",
}  # fmt: skip


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_killed_in_every_phase_it_goes_on_to_the_same_models(undisturbed, processes):
    """In the middle of each phase, and as each is finished."""
    whole, _, _ = undisturbed
    layout = IterationFolder(processes.folder / "data")
    for phase in PHASES:
        process = processes.start(*words(layout.root))
        until_exists(layout.root / BEGUN[phase], process)
        kill(process, layout)
        process = processes.start(*words(layout.root))
        process.wait_for(f"round {phase.round}  {phase.name} ")
        kill(process, layout)
    processes.printed(*words(layout.root))
    assert hashes(layout) == hashes(whole)
    assert list(IterationLedger.load(layout.ledger).finished) == PHASES


def test_one_iteration_works_in_a_folder_and_ctrl_c_ends_all_that_it_started(processes):
    layout = IterationFolder(processes.folder / "data")
    process = processes.start(*words(layout.root))
    until_exists(layout.root / "episodes", process)
    processes.refused(str(layout.root), *words(layout.root))
    assert process.stop(signal.SIGINT)[0] == 130
    assert f"iterate --data {layout.root}" in process.last_line()
    assert not left(layout.root)


def test_damage_is_said_and_made_good(undisturbed, processes):
    whole, _, _ = undisturbed
    layout = IterationFolder(processes.folder / "data")
    shutil.copytree(whole.root, layout.root, symlinks=True)
    layout.bundle(2).write_bytes(b"")
    processes.refused(str(layout.bundle(2)), "iterate", "--data", layout.root, code=1)
    processes.printed("iterate", "--data", layout.root, "--redo", "2/bundle")
    assert hashes(layout) == hashes(whole)


CONTRASTED = (
    "--mdnrnn-flags", "--updates 3 --batch 2 --set latent=4 hidden=4 validate_every=1", "--run-flags", RUN,
    "--kind", "plain", "", "--kind", "attentive", "--set window=2 attention_units=2", "--local", 1,
)  # fmt: skip


@pytest.fixture
def data(tmp_path):
    return write_encoded_drives(tmp_path / "data")


@pytest.mark.long
def test_a_stopped_contrast_continues_and_compares_the_kinds(processes, data, tmp_path):
    words = ("lab", "contrast", "--data", data, "--out", tmp_path / "out", "--seeds", 1, *CONTRASTED)
    first = processes.start(*words)
    first.wait_for("plain-1")
    code, _ = first.stop()
    assert code == 130, first.lines

    answer = json.loads(processes.printed(*words, "--json"))
    assert [each["kind"] for each in answer["trials"]] == ["plain", "attentive"]
    for each in answer["trials"]:
        model = Bundle.open(tmp_path / "out" / f"{each['kind']}-1" / f"{each['kind']}-1.zip").manifest
        assert model.models["mdnrnn"]["window"] == (2 if each["kind"] == "attentive" else 0)
        assert each["quality"]["nats_per_dimension"] == model.provenance["quality"]["nats_per_dimension"]
        with open_run(tmp_path / "out" / "runs", f"{each['kind']}-1") as run:
            assert run.ended == "2 generations"
            assert each["score"] == max(evaluation.mean for evaluation in run.evaluations())
    processes.refused("run_flags", *words, "--run-flags", "--generations 9")


def test_what_cannot_be_contrasted_is_said_at_once(tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    refused(str(empty), "lab", "contrast", "--data", empty, "--out", tmp_path / "out", code=1)
    for flags, why in (
        ("--sigma0 0.1", "--generations"),
        ("--generations 2 --seed 4", "--seed"),
        ("--generations 2 --population 1", "--population"),
    ):
        refused(why, "lab", "contrast", "--data", empty, "--out", tmp_path / "out", "--run-flags", flags)
