"""Runs whose jobs fail as a test says."""

import pytest

from tests.support.failing_runs import SETTINGS, Failing


@pytest.fixture
def begin(tmp_path, random_bundle):
    """Begins a run whose jobs fail where `fails(job)`; two hosts score it once it is served."""
    made = []

    def begin(fails=lambda job: False, settings=SETTINGS, kind=Failing, **options):
        made.append(kind(tmp_path / str(len(made)) / "night", random_bundle.path, settings, fails=fails, **options))
        return made[-1]

    yield begin
    for each in made:
        each.journal.close()


@pytest.fixture
def failing(begin):
    """Begins a run and serves it."""

    def build(**options):
        bench = begin(**options)
        bench.serve()
        return bench

    return build
