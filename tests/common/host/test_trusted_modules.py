"""What a refusal of a module says."""

import re

import pytest

from dreamfleet.common.errors import UsageError
from dreamfleet.common.host.trusted_modules import VARIABLE, _place_hint, check_trusted


@pytest.mark.parametrize("module", ["sqlite3.dbapi9", "no_such_module_of_mine", "no_such_package.inside"])
def test_a_refusal_says_each_remedy_that_is_needed(module, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(UsageError) as caught:
        check_trusted(module, "task 'mine'")
    said = str(caught.value)
    assert re.search(f"--trust.* {VARIABLE}.*{module}", said)
    assert said.endswith(_place_hint(module))
    assert bool(_place_hint(module)) == module.startswith("no_such")
