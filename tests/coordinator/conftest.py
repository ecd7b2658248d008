"""What several tests of the coordinator begin from."""

import pytest


@pytest.fixture
def make_bench(tmp_path, random_bundle):
    """Makes benches of a kind, each in a folder of its own; their journals are closed with the test."""
    made = []

    def make(kind, *given, **options):
        made.append(kind(tmp_path / "runs" / f"night-{len(made)}", random_bundle.path, *given, **options))
        return made[-1]

    yield make
    for each in made:
        each.journal.close()
