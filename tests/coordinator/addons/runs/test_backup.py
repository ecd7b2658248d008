"""A copy of a run while something is done to it."""

from dreamfleet.common.runs.run_folder import RunFolder
from dreamfleet.common.runs.run_paths import CONTROLLER
from dreamfleet.coordinator.addons.runs import backup
from dreamfleet.coordinator.run.recall import bar_stored
from tests.support.failing_runs import SETTINGS, finished


def test_a_copy_during_which_results_are_recalled_has_no_controller_of_theirs(tmp_path, random_bundle, monkeypatch):
    bench = finished(tmp_path, random_bundle, SETTINGS, fails=lambda job: False)
    bench.journal.close()
    assert (bench.path / CONTROLLER).exists()
    copies, copy_journal = [], backup._copy_journal

    def recalled_meanwhile(source, path):
        if not copies:
            bar_stored(bench.path, "a", is_barred=True)
        copies.append(path)
        copy_journal(source, path)

    monkeypatch.setattr(backup, "_copy_journal", recalled_meanwhile)
    with RunFolder(bench.path) as source:
        backup.back_up(source, tmp_path / "safe" / bench.path.name)
    assert len(copies) == 2
    with RunFolder(tmp_path / "safe" / bench.path.name) as copy:
        assert copy.checks.barred == ("a",)
        assert not copy.controller_path.exists()
