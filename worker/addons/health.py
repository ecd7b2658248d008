"""The worker's own checks for `dreamfleet doctor`. Pages: first-drive.md, troubleshooting.md."""

from collections.abc import Iterator

from dreamfleet.common.addons.doctor.health import Finding
from dreamfleet.common.errors import DreamfleetError


def examine() -> Iterator[Finding]:
    """Check that the native CarRacing was built and is equal to the installed gymnasium's."""
    remedy = "install a C compiler, then pip install --force-reinstall --no-deps dreamfleet; gymnasium draws until then"
    try:
        from dreamfleet.worker.worlds.car_racing.environment import find_reference, is_native_available
        from dreamfleet.worker.worlds.car_racing.native_check import native_is_exact
    except ModuleNotFoundError as error:
        yield Finding("native picture", False, False, f"no {error.name}", "worker", "pip install 'dreamfleet[worker]'")
        return
    try:
        is_exact = native_is_exact()
    except DreamfleetError as error:  # nothing else drives here
        yield Finding("native picture", False, True, str(error), "worker", "pip install box2d pygame-ce")
        return
    if not is_native_available():
        yield Finding("native picture", False, find_reference() is None, "not built", "worker", remedy)
    elif not is_exact:
        remedy = "install the tested versions of gymnasium and pygame-ce; gymnasium draws until then"
        yield Finding("native picture", False, False, "differs from gymnasium's", "worker", remedy)
    else:
        found = "equal to gymnasium's" if find_reference() else "alone, and equal to a drive in gymnasium"
        yield Finding("native picture", True, False, found, "worker", "")
