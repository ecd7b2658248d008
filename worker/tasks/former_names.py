"""Former names of the task contract, which tasks of other packages may still use: those on the left of each table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

FORMER_NAMES = {
    "make_judge": "make_evaluation_environment",
    "make_shown": "make_watched_environment",
    "width": "batch_size",
}
FORMER_OBSERVER_NAMES = {"due": "is_due", "see": "observe"}
FORMER_WORLD_FIELDS = {"stray": "off_course", "stray_cost": "off_course_cost"}


def accept_former_names(instance: Any, names: Mapping[str, str] = FORMER_NAMES) -> None:
    """Give an instance and its classes, where they define one of `names`, its counterpart too, in both directions."""
    for owner in (instance, *type(instance).__mro__):
        add_former_names(owner, names)


def add_former_names(owner: Any, names: Mapping[str, str] = FORMER_NAMES) -> None:
    """Give one class or instance the counterparts of what it defines itself."""
    own = dict(getattr(owner, "__dict__", {}))
    for pair in names.items():
        for given, other in (pair, pair[::-1]):
            if given in own and other not in own:
                # A frozen dataclass refuses `setattr`.
                (setattr if isinstance(owner, type) else object.__setattr__)(owner, other, own[given])


class FormerFields(type):
    """The type of `World` and its subclasses, which are built by former names of fields too."""

    def __call__(cls, *values: Any, **fields: Any) -> Any:
        """Build one; `dataclasses.replace` passes a field by both names, and then the former one is the new value."""
        former = {present: fields.pop(name) for name, present in FORMER_WORLD_FIELDS.items() if name in fields}
        return super().__call__(*values, **{**fields, **former})
