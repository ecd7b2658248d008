"""The tutorial's own function and commands lead to its minimum, on a small scale."""

import pytest

from tests.docs.tutorial import WHOLE, run_tutorial


@pytest.mark.slow
@pytest.mark.timeout(WHOLE + 60)
def test_its_commands_work_as_they_stand(tmp_path):
    run_tutorial("own-objective.md", "tune.py", {}, tmp_path)
    assert (tmp_path / "tune.png").stat().st_size > 1000
