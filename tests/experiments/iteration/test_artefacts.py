"""The files of an iteration: missed when they are needed, and undone. Tests layout.py and phases.py."""

import pytest

from dreamfleet.common.artifacts.bundle_store import find_bundle
from dreamfleet.common.errors import DatasetError, UsageError
from dreamfleet.common.host.stop_signals import never_stop
from dreamfleet.experiments.iteration import artefacts, phases
from dreamfleet.experiments.iteration.config import IterateConfig
from dreamfleet.experiments.iteration.layout import IterationFolder
from dreamfleet.experiments.iteration.plan import Phase, PhasePlan
from dreamfleet.experiments.iteration.requests import Requests
from dreamfleet.worker.training.stages.encode import encode_drives
from tests.support.ledgers import entry, ledger
from tests.support.variants import controller_of


def write(path, text="content"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


@pytest.fixture
def layout(tmp_path):
    return IterationFolder(tmp_path / "data")


def drive(layout, number):
    write(layout.root / "encoded" / f"{number:06d}.npz")
    return write(layout.root / "episodes" / f"{number:06d}.npz", f"drive {number}")


@pytest.fixture
def finished(layout):
    """The ledger of two rounds: drives 0 and 1 at random, drive 2 by a controller."""

    def made(number, phase, *paths, **figures):
        return entry(number, phase, artefacts.hash_artefacts(layout, paths), **figures)

    return ledger(
        made(1, "collect", drive(layout, 0), drive(layout, 1), episodes=2),
        made(1, "vae", write(layout.checkpoint(1, "vae"))),
        made(1, "bundle", write(layout.bundle(1))),
        made(1, "evolve", write(layout.run(1) / "controller.npz")),
        made(2, "drive", drive(layout, 2), episodes=3),
        made(2, "vae", write(layout.checkpoint(2, "vae"))),
        made(2, "bundle", write(layout.bundle(2))),
    )


@pytest.mark.parametrize(
    ("path", "phase"),
    [("episodes/000001.npz", "1/collect"), ("episodes/000002.npz", "2/drive"), ("rounds/02/round-2.zip", "2/bundle"),
     ("runs/round-01/controller.npz", "1/evolve")],
)  # fmt: skip
def test_damage_names_the_file_and_the_command_that_makes_it_again(layout, finished, path, phase):
    artefacts.check(layout, finished)
    for damage in (lambda file: file.write_text("other"), lambda file: file.unlink()):
        damage(layout.root / path)
        with pytest.raises(DatasetError, match=rf"{path} .* --redo {phase}$"):
            artefacts.check(layout, finished)


def test_models_that_nobody_asks_for_any_more_may_go(layout, finished):
    layout.bundle(1).unlink()
    layout.checkpoint(1, "vae").unlink()
    passed, refused = (
        finished.add(entry(2, "gate", kept=kept)).add(entry(2, "evolve")).add(entry(3, "drive", episodes=3))
        for kept in (True, False)
    )
    artefacts.check(layout, passed)
    with pytest.raises(DatasetError, match=r"vae\.safetensors"):
        artefacts.check(layout, refused)


def undo(layout, finished, phase):
    plan = PhasePlan(IterateConfig(rounds=2))
    phases = [each for each in plan.phases(1) + plan.phases(2) if each in finished.finished]
    return artefacts.undo(layout, finished, phases[phases.index(Phase.of(phase)) :])


def test_what_is_undone_is_gone_and_what_stood_before_is_not(layout, finished):
    write(layout.round(2) / "vae.jsonl")
    before = undo(layout, finished, "2/vae")
    assert before.finished[-1] == (2, "drive")
    assert not list(layout.round(2).iterdir())
    assert len(artefacts.drive_files(layout)) == 3
    artefacts.check(layout, before)


def test_drives_of_controllers_are_undone_with_their_latents(layout, finished):
    drive(layout, 3)  # begun, and in no ledger
    before = undo(layout, finished, "1/evolve")
    assert before.episodes == 2
    for kind in ("episodes", "encoded"):
        assert sorted(each.stem for each in (layout.root / kind).iterdir()) == ["000000", "000001"]
    assert not layout.run(1).exists()
    assert layout.bundle(1).exists()


def test_random_drives_are_driven_again_only_where_they_are_damaged(layout, finished):
    (layout.root / "episodes" / "000001.npz").write_text("other")
    before = undo(layout, finished, "1/collect")
    assert not before.entries
    assert [each.stem for each in artefacts.drive_files(layout)] == ["000000"]


def test_no_training_goes_on_from_a_rounded_world_model(tmp_path):
    controller_of(find_bundle("tiny-int8")).save(tmp_path / "own.npz")
    whole = find_bundle("tiny").sha256[:12]
    with pytest.raises(UsageError, match=rf"own\.npz .* tiny .*{whole}"):
        phases.find_init(str(tmp_path / "own.npz"), tmp_path)


@pytest.mark.parametrize("phase", ["mdnrnn", "bundle"])
def test_latents_are_made_again_where_they_are_needed(layout, phase, monkeypatch):
    asked = []

    def run(stage, *_):
        asked.append(stage.__name__)
        if stage is not encode_drives:
            raise DatasetError("enough")

    monkeypatch.setattr(phases, "run_isolated", run)
    requests = Requests(IterateConfig(), layout, ledger())
    with pytest.raises(DatasetError):
        phases.PhaseRunner(requests, None, never_stop, asked.append).do(Phase(1, phase))
    assert asked == ["encode_drives", "build_bundle" if phase == "bundle" else "train_model"]
