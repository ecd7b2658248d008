"""Runs whose jobs fail as a test says."""

import pytest

from tests.support.failing_runs import SETTINGS, Failing


@pytest.fixture
def begin(make_bench):
    """Begins a run whose jobs fail where `fails(job)`; two hosts score it once it is served."""
    return lambda fails=lambda job: False, settings=SETTINGS, kind=Failing, **options: make_bench(
        kind, settings, fails=fails, **options
    )


@pytest.fixture
def failing(begin):
    """Begins a run and serves it."""

    def build(**options):
        bench = begin(**options)
        bench.serve()
        return bench

    return build
