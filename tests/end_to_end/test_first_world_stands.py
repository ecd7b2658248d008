"""CarRacing computes what it did when it was the only world: the same words everywhere, the same bits on equal hosts.

`tests/support/first_world.py` says what is compared, and writes the fixture.
"""

import json

import pytest

from tests.support.first_world import GOLD, HOST, PARTS

# SWIG warns as Box2D is imported, and an error there kills the process.
pytestmark = pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")


@pytest.mark.parametrize("part", PARTS)
def test_the_first_world_computes_what_it_did(part, tmp_path):
    gold = json.loads(GOLD.read_text())[part]
    found = json.loads(json.dumps(PARTS[part](tmp_path)))
    assert found.keys() == gold.keys()
    for kind, recorded in gold.items():
        if recorded["host"] == HOST[kind]:
            assert found[kind] == recorded["found"], kind
