"""The structure that architecture.md describes: what must not grow again."""

from deploy.structure import SIDES, class_names, floors, room_arrows, sources

MOST_FILES = 20  # in a folder


def test_no_room_imports_a_room_above_it():
    for side in SIDES:
        assert floors(room_arrows(side))[1] == 0, side


def test_a_public_class_name_has_one_meaning():
    assert class_names() == {}


def test_common_and_coordinator_hold_rooms_and_nothing_flat_but_what_every_room_uses():
    flat = {str(path) for side in ("common", "coordinator") for path in sources(side) if len(path.parts) == 2}
    assert flat == {"common/__init__.py", "common/errors.py", "common/printable.py", "coordinator/__init__.py"}


def test_a_folder_is_read_at_a_glance():
    counts: dict[str, int] = {}
    for path in sources(*SIDES):
        counts[str(path.parent)] = counts.get(str(path.parent), 0) + (path.name != "__init__.py")
    assert max(counts.values()) <= MOST_FILES, counts
