"""What is installed on a host: this dreamfleet as a wheel, and the versions of the packages that it needs.

The wheel is packed from the installed files. This needs no checkout, build or network, and remote workers run the same
code as this host.
"""

import base64
import hashlib
import io
import os
import platform
import re
import sysconfig
import zipfile
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import Distribution, PackageNotFoundError, distribution, version
from importlib.resources import files as resources
from pathlib import Path

from dreamfleet.common.errors import DreamfleetError
from dreamfleet.common.files.archives import write_archive

NAME = "dreamfleet"
NATIVE = (".so", ".pyd", ".dylib")
EXTRA = "worker"
_REQUIREMENT = re.compile(r"([A-Za-z0-9._-]+)[^;]*(?:;(.*))?")


@dataclass(frozen=True)
class Wheel:
    """A wheel's file name and bytes."""

    name: str
    data: bytes

    @cached_property
    def sha256(self) -> str:
        """Hash of its bytes."""
        return hashlib.sha256(self.data).hexdigest()


@dataclass(frozen=True)
class Parcel:
    """The files for an environment; without a wheelhouse, dependencies come from a package index."""

    wheel: Wheel
    pins: str
    wheelhouse: Path | None = None

    def environment(self, python: tuple[int, ...], machine: str) -> str:
        """The name of the environment, with a hash of everything that it depends on."""
        house = [f"{each.name} {each.stat().st_size}" for each in self._wheels()]
        text = "\n".join([self.wheel.sha256, self.pins if not house else "", *house, *map(str, python), machine])
        return f"{version(NAME)}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"

    def files(self) -> dict[str, bytes]:
        """The files to send, by name."""
        house = {each.name: each.read_bytes() for each in self._wheels()}
        return {**house, "pins.txt": self.pins.encode(), self.wheel.name: self.wheel.data}

    def check_fits(self, machine: str) -> None:
        """`DreamfleetError` if the wheelhouse has wheels for other processors only."""
        tags = {each.stem.rpartition("-")[2] for each in self._wheels()} - {"any"}
        if tags and not any(machine in tag or "universal2" in tag for tag in tags):
            raise DreamfleetError(
                f"its processor is {machine}, and {self.wheelhouse} holds wheels of {', '.join(sorted(tags))} alone: "
                f"fill another one there, or by `pip download --platform manylinux_2_28_{machine} --only-binary :all:`"
            )

    def _wheels(self) -> list[Path]:
        return sorted(self.wheelhouse.glob("*.whl")) if self.wheelhouse else []


@cache
def pack(wheelhouse: Path | None, *, native: bool) -> Parcel:
    """This installation, packed once a process.

    `native` includes the compiled renderer, which runs only on the same kind of processor.
    """
    return Parcel(pack_wheel(native=native), pins(), wheelhouse)


def runs_here(system: str, machine: str) -> bool:
    """Whether code compiled here runs on that host."""
    return (system, machine) == (platform.system(), platform.machine()) == ("Linux", machine)


def pack_wheel(*, native: bool) -> Wheel:
    """A wheel of this installation, editable or not; equal files give equal bytes."""
    found = _distribution()
    head = f"{NAME}-{found.version}"
    about = f"{head}.dist-info"
    files = dict(_modules(native))
    has_native = any(name.endswith(NATIVE) for name in files)
    platform_tag = re.sub(r"[^a-z0-9]", "_", sysconfig.get_platform().lower())
    tag, pure = (f"cp311-abi3-{platform_tag}", "false") if has_native else ("py3-none-any", "true")  # pyproject.toml
    files[f"{about}/METADATA"] = _text(found, "METADATA", "PKG-INFO")
    files[f"{about}/entry_points.txt"] = _text(found, "entry_points.txt")
    files[f"{about}/WHEEL"] = f"Wheel-Version: 1.0\nGenerator: {NAME}\nRoot-Is-Purelib: {pure}\nTag: {tag}\n".encode()
    record = f"{about}/RECORD"
    lines = [f"{name},sha256={_digest(data)},{len(data)}" for name, data in files.items()]
    files[record] = "\n".join([*lines, f"{record},,", ""]).encode()
    out = io.BytesIO()
    write_archive(out, files.items(), zipfile.ZIP_DEFLATED)
    return Wheel(f"{head}-{tag}.whl", out.getvalue())


def pins() -> str:
    """The versions of a worker's packages here, as pip constraints, so that hosts compute equal bits."""
    lines = []
    for each in _distribution().requires or ():
        found = _REQUIREMENT.match(each)
        if found is None or ("extra ==" in (found[2] or "") and EXTRA not in found[2]):
            continue
        try:
            lines.append(f"{found[1]}=={version(found[1])}\n")
        except PackageNotFoundError:
            continue
    return "".join(sorted(lines))


def _modules(native: bool) -> list[tuple[str, bytes]]:
    root = Path(str(resources(NAME)))
    found = []
    for folder, folders, names in os.walk(root, followlinks=True):  # in a checkout, these folders are links
        folders[:] = sorted(each for each in folders if each != "__pycache__")
        for name in sorted(names):
            path = Path(folder, name)
            if path.suffix != ".pyc" and (native or not name.endswith(NATIVE)):
                found.append((f"{NAME}/{path.relative_to(root).as_posix()}", path.read_bytes()))
    return found


def _distribution() -> Distribution:
    try:
        return distribution(NAME)
    except PackageNotFoundError:
        raise DreamfleetError("dreamfleet is not installed here, so nothing can be packed: pip install it") from None


def _text(found: Distribution, *names: str) -> bytes:
    for name in names:
        if text := found.read_text(name):
            return text.encode()
    raise DreamfleetError(f"this installation lacks {names[0]}: install dreamfleet again")


def _digest(data: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
