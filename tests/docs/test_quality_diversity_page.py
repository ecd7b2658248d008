"""The commands of docs/how-to/quality-diversity.md work as they stand, on a small scale."""

import pytest

from tests.docs.tutorial import WHOLE, run_page

SHARES = {"--population 48 --episodes 2 --generations 40": "--population 12 --episodes 1 --generations 3",
          "--episodes 20": "--episodes 2"}  # fmt: skip


@pytest.mark.slow
@pytest.mark.timeout(WHOLE + 60)
def test_its_commands_work_as_they_stand(tmp_path):
    printed = run_page("how-to/quality-diversity.md", SHARES, tmp_path)
    assert " of 144 cells filled" in printed
    assert (tmp_path / "swing-archive.png").stat().st_size > 10_000
    assert (tmp_path / "swing-csv" / "elites.npz").exists()
