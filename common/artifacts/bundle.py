"""The frozen world model as one content-addressed file: a manifest and its parts in an uncompressed zip.

The file's SHA-256 is its identity. Equal parts give equal files: entries are sorted, uncompressed, without dates.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from dreamfleet.common.artifacts.actions import MAX_OUTPUTS
from dreamfleet.common.artifacts.controller import Controller, ControllerShape, import_hint
from dreamfleet.common.artifacts.driving import Driving, Variant, parse_driving
from dreamfleet.common.artifacts.onnx_checks import find_fault, read_float_array
from dreamfleet.common.artifacts.world_facts import WorldFacts
from dreamfleet.common.errors import BundleError, ControllerError, UsageError
from dreamfleet.common.files.archives import Archive, ArchiveLimits, DamagedArchiveError, open_archive, write_archive
from dreamfleet.common.files.atomic_write import atomic_write
from dreamfleet.common.files.regular_files import is_folder, open_regular, read_regular
from dreamfleet.common.printable import plural
from dreamfleet.common.schema.display import Displayed
from dreamfleet.common.schema.validation import OPTIONAL, MalformedError, Word, from_plain, to_plain

FORMAT = 1
TO_BUNDLE = ("--out", "world.zip")  # of `import`, for another program's world model
MANIFEST = "manifest.json"
ENCODER, DECODER, POLICY, INITIAL_LATENTS_PART = "encoder.onnx", "decoder.onnx", "policy.onnx", "initial_latents.npy"
DREAM_GRAPH = "dream.onnx"  # one step of the dream
RECORDED_STATES = "recorded_states.npy"  # states of recorded drives; only in bundles whose dreams may begin there
# Graphs for controllers of any size; their input holds a controller in each row.
LINEAR_CONTROLLER, LAYERED_CONTROLLER = "controller-linear.onnx", "controller-hidden.onnx"
WEIGHTS = "weights.safetensors"  # only in bundles from which training can continue
EIGHT_BITS = "eight_bits"  # among a manifest's models: the ranges of eight-bit products
SINGLE_PRECISION = "single_precision"  # in the provenance of a bundle of eight bits: SHA-256 of what was rounded
REQUIRED = (ENCODER, DECODER, DREAM_GRAPH, INITIAL_LATENTS_PART)  # parts without which it is no bundle
MAX_BUNDLE = 256 << 20  # bytes, of the file and of its members together; docs/how-to/security.md and R2 say it too
LIMITS = ArchiveLimits(MAX_BUNDLE)  # docs/reference/protocol.md, R2
MAX_MANIFEST = 1_000_000
MAX_ARRAY = 64 << 20  # bytes of a part that is an array: it is copied as float32 when it is read
MAX_RECORDED_STATES = 16_384  # states; 19 MB with the default layers


@dataclass(frozen=True)
class BundleManifest:
    """A bundle's manifest: its shapes, task and preprocessing, its world, the hash of each part, and its provenance."""

    name: Word
    task: Word
    preprocessing: Word
    picture: tuple[int, ...]  # height, width, channels of the encoder's 8-bit input
    latent: Annotated[int, Meta(ge=1, le=10_000)]
    hidden: Annotated[int, Meta(ge=1, le=100_000)]
    actions: Annotated[int, Meta(ge=1, le=MAX_OUTPUTS)]
    world: WorldFacts
    parts: dict[str, Any] = field(default_factory=dict)  # name -> SHA-256; `write_bundle` fills it in
    provenance: dict[str, Any] = field(default_factory=dict)
    format: int = FORMAT
    # The configurations of `vae` and `mdnrnn`; empty in older bundles, which have the paper's.
    models: dict[str, Any] = field(default_factory=dict, metadata=OPTIONAL)


class Bundle(Displayed):
    """A verified bundle, the shape of the controllers that drive by it, and how they drive.

    >>> from dreamfleet import find_bundle
    >>> bundle = find_bundle("tiny")
    >>> bundle.manifest.latent, bundle.manifest.hidden, bundle.controller_shape.size
    (32, 256, 867)
    >>> bundle
    <Bundle tiny of car-racing: latent 32, hidden 256, SHA-256 2c7f1b10019c>
    """

    def __init__(
        self, path: Path, sha256: str, manifest: BundleManifest, shape: ControllerShape | None = None,
        driving: Driving | None = None,
    ) -> None:  # fmt: skip
        self.path = path
        self.sha256 = sha256
        self.manifest = manifest
        self.driving: Driving = driving or self.driving_of("")
        self._shape = shape

    def _display(self) -> tuple[str, dict[str, object]]:
        manifest, digest = self.manifest, self.sha256[:12]
        sizes = f"latent {manifest.latent}, hidden {manifest.hidden}"
        facts = {
            "task": manifest.task,
            "pictures": " x ".join(map(str, manifest.picture)) + f", {manifest.preprocessing}",
            "latent": manifest.latent,
            "hidden": manifest.hidden,
            "actions": manifest.actions,
            "controllers": f"{plural(self.controller_shape.size, 'parameter')}",
            "file": str(self.path),
            "SHA-256": digest,
        }
        return f"Bundle {manifest.name} of {manifest.task}: {sizes}, SHA-256 {digest}", facts

    @classmethod
    def open(cls, path: Path | str, sha256: str | None = None) -> Bundle:
        """Read and verify a bundle: archive, manifest, the hash of each part, and of the file if `sha256` is given.

        The file is read once, so replacing it meanwhile cannot bypass the check. `BundleError` describes the fault.
        """
        path = Path(path)
        try:
            data = read_regular(path, MAX_BUNDLE)
        except FileNotFoundError:
            raise BundleError(f"no bundle at {path}") from None
        except OSError as error:
            remedy = import_hint(path, *TO_BUNDLE) if is_folder(path) else "fetch or build it again"
            raise BundleError(f"{path} is not a whole bundle ({error.strerror}); {remedy}") from error
        return cls.from_bytes(path, data, sha256)

    @classmethod
    def from_bytes(cls, path: Path, data: bytes, wanted: str | None) -> Bundle:
        """Verify the bytes of a bundle's file; `path` is where they were read."""
        found = hashlib.sha256(data).hexdigest()
        if wanted is not None and found != wanted:
            raise BundleError(
                f"{path} is another world model: its hash is {found[:12]}..., not {wanted[:12]}...; "
                "put the right one there; a cached one may be deleted, and is fetched again"
            )
        try:
            with open_archive(io.BytesIO(data), LIMITS) as archive:
                manifest = _read_manifest(archive, path)
                for name in {*REQUIRED, *manifest.parts}:
                    _check_part(path, manifest, name, _read_part(archive, path, manifest, name))
        except DamagedArchiveError as error:
            if path.suffix in ("", ".zip"):
                raise BundleError(f"{path} is not a whole bundle ({error}); fetch or build it again") from error
            if path.suffix == ".npz":
                raise BundleError(f"{path} is not a bundle; a controller goes to --init or --controller") from error
            folder = path.parent.parent if path.suffix == ".tar" else path.parent
            raise BundleError(f"{path} is not a bundle; {import_hint(folder, *TO_BUNDLE)}") from error
        return cls(path, found, manifest)

    @property
    def default_shape(self) -> ControllerShape:
        """The shape of a linear controller on latent and hidden state; a policy graph contains such a one."""
        return self.shape_of("zh")

    @property
    def controller_shape(self) -> ControllerShape:
        """The shape of this bundle's controllers: `default_shape` unless `with_controllers` chose another."""
        return self._shape or self.default_shape

    @property
    def variant(self) -> Variant:
        """The variant of CarRacing by which its controllers drive; `UsageError` for another world's bundle."""
        if not isinstance(self.driving, Variant):
            raise UsageError(f"{self.path.name} is of {self.manifest.task}, which has no such variants")
        return self.driving

    def driving_of(self, options: str) -> Driving:
        """How controllers drive under a run's options, JSON or empty; `UsageError` for options that do not exist."""
        return parse_driving(self.manifest.task, self.manifest.world, options)

    def shape_of(self, features: str, hidden: int = 0, driving: Driving | None = None) -> ControllerShape:
        """The shape of controllers on `features`, with `hidden` units between (0: linear).

        `features` is `z` (latent) or `zh` (latent and hidden state). `driving` may add outputs and features; `None`
        has the world's own actions.
        """
        driving = driving or self.driving_of("")
        width = self.manifest.latent + (self.manifest.hidden if features == "zh" else 0)
        return ControllerShape(width + driving.extra_features, driving.controls.outputs, hidden)

    def with_options(self, shape: ControllerShape | None, options: str) -> Bundle:
        """This bundle for controllers of a run with these options, JSON or empty; errors as in `with_controllers`.

        `UsageError` also for options that the bundle's world does not have.
        """
        return self.with_controllers(shape, self.driving_of(options))

    def with_controllers(self, shape: ControllerShape | None, driving: Driving | None = None) -> Bundle:
        """This bundle for controllers of another shape, or that drive otherwise; `None`: linear ones on all features.

        `ControllerError` if they do not fit it; `BundleError` if its world has no such options.
        """
        try:
            driving = self.driving_of(driving.options if driving else "")
        except UsageError as error:
            raise BundleError(f"{self.path.name} is of {self.manifest.task}: {error}") from error
        if driving.is_default and shape in (None, self.default_shape):
            return Bundle(self.path, self.sha256, self.manifest)
        shape = shape or self.shape_of("zh", driving=driving)
        if shape not in (self.shape_of(features, shape.hidden, driving) for features in ("z", "zh")):
            fitting = self.shape_of("zh", driving=driving)
            raise ControllerError(
                f"a controller of {plural(shape.size, 'parameter')} does not fit {self.path.name}, which needs "
                f"{fitting.size}, or other inputs: latent {self.manifest.latent}, hidden "
                f"{self.manifest.hidden}, {fitting.actions} actions"
            )
        return Bundle(self.path, self.sha256, self.manifest, shape, driving)

    def for_controller(self, controller: Controller) -> Bundle:
        """This bundle for one controller, which drives as its options say; errors as in `with_options`.

        `ControllerError` also for a controller that was evolved on another world model. One that was rounded to eight
        bits is the same.
        """
        found = self.with_options(controller.shape, controller.options)
        if controller.bundle not in self.same_models:
            from dreamfleet.common.artifacts.bundle_store import describe_bundle  # imports this module

            raise ControllerError(
                f"the controller belongs to {describe_bundle(controller.bundle)}, not to {self.path.name} "
                f"({self.sha256[:12]}...): omit --bundle, or fit it to this one by `dreamfleet lab refit`"
            )
        return found

    @property
    def same_models(self) -> tuple[str, ...]:
        """SHA-256 of the bundles whose controllers drive by this one: itself, and the one that was rounded to it."""
        rounded = self.manifest.provenance.get(SINGLE_PRECISION)
        return (self.sha256,) if rounded is None else (self.sha256, str(rounded))

    @property
    def recorded_count(self) -> int:
        """Number of recorded states that its dreams may begin at."""
        return len(self.read_recorded()) if RECORDED_STATES in self.manifest.parts else 0

    def check_recorded(self) -> None:
        """`BundleError` if no dream can begin at a recorded state."""
        if RECORDED_STATES not in self.manifest.parts:
            raise BundleError(
                f"{self.path.name} holds no recorded states that dreams could begin at: build it again with "
                "`dreamfleet bundle --recorded N`, or omit --recorded"
            )

    def read_recorded(self) -> NDArray[np.float32]:
        """Recorded states `(N, 2 * latent + state)`: mu, logvar and the recurrent state; `BundleError` if none."""
        self.check_recorded()
        return read_float_array(self.read(RECORDED_STATES))

    def read(self, name: str) -> bytes:
        """One part's bytes, checked against its hash in the manifest; `BundleError` if there is no such part."""
        if name not in self.manifest.parts:
            raise BundleError(f"{self.path} holds no {name}")
        try:
            with open_regular(self.path, MAX_BUNDLE) as file, open_archive(file, LIMITS) as archive:
                return _read_part(archive, self.path, self.manifest, name)
        except (OSError, DamagedArchiveError) as error:
            raise BundleError(f"{self.path} was changed while it was in use ({error}); fetch it again") from error


def write_bundle(path: Path, manifest: BundleManifest, parts: Mapping[str, bytes]) -> Bundle:
    """Write a bundle atomically, and open it; `BundleError` or `OSError`, and no file, for one that `open` refuses."""
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in sorted(parts.items())}
    text = json.dumps({**to_plain(manifest), "parts": hashes}, indent=1, sort_keys=True)
    with atomic_write(path) as file:
        write_archive(file, [(MANIFEST, text.encode()), *sorted(parts.items())])
        file.flush()
        return Bundle.from_bytes(path, read_regular(Path(file.name), MAX_BUNDLE), None)  # before it replaces another


def hash_file(path: Path) -> str:
    """SHA-256 of a file, hexadecimal; `OSError` if it is not a regular file."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check_part(path: Path, manifest: BundleManifest, name: str, data: bytes) -> None:
    """`BundleError` for a part that would fail, or give nonsense, only during scoring."""
    if name.endswith(".onnx") and (fault := find_fault(data)):
        raise BundleError(f"{path}: {name} {fault}; fetch the bundle again, or build it again from sound models")
    if name in (INITIAL_LATENTS_PART, RECORDED_STATES):
        _check_states(path, manifest, name, data)


def _check_states(path: Path, manifest: BundleManifest, name: str, data: bytes) -> None:
    """`BundleError` for states that no dream can begin at.

    The exact width of recorded ones is in the dream's graph, which is not read here.
    """
    if len(data) > MAX_ARRAY:
        raise BundleError(f"{path}: {name} unpacks to {len(data) >> 20} MiB, and at most {MAX_ARRAY >> 20} are read")
    try:
        states = read_float_array(data)
    except ValueError as error:
        raise BundleError(f"{path}: {name} is not an array of states ({error}); build the bundle again") from error
    count, width = len(states) if states.ndim else 0, 2 * (manifest.latent + manifest.hidden)
    if name == INITIAL_LATENTS_PART:
        wanted, fits = f"(N, 2, {manifest.latent}) with N at least 1", states.shape[1:] == (2, manifest.latent)
    else:
        wanted = f"(N, W) with N from 1 to {MAX_RECORDED_STATES} and W at least {width}"
        fits = states.ndim == 2 and count <= MAX_RECORDED_STATES and states.shape[1] >= width
    if not (count and fits):
        raise BundleError(f"{path}: {name} must be {wanted}, not {states.shape}; build the bundle again")
    if not np.isfinite(states).all():
        raise BundleError(f"{path}: {name} holds NaN or infinity; build the bundle again")


def read_bytes_or_none(path: Path) -> bytes | None:
    """The bytes of a file; `None` if it does not exist or cannot be read."""
    try:
        return read_regular(path, MAX_BUNDLE)
    except OSError:
        return None


def _read_part(archive: Archive, path: Path, manifest: BundleManifest, name: str) -> bytes:
    data = archive.read(name)
    if hashlib.sha256(data).hexdigest() != manifest.parts.get(name):
        raise BundleError(f"{path}: part {name} is damaged; fetch or build the bundle again")
    return data


def _read_manifest(archive: Archive, path: Path) -> BundleManifest:
    try:
        plain = json.loads(archive.read(MANIFEST, MAX_MANIFEST))
        if plain["format"] != FORMAT:
            raise BundleError(f"{path} has bundle format {plain['format']!r:.20}; this version reads {FORMAT}")
        manifest = from_plain(BundleManifest, plain)
        if not all(isinstance(each, dict) for each in manifest.models.values()):
            raise MalformedError("models are not configurations")
        for name in ("reward_scale", "first_reward"):
            if any(not _is_number(each.get(name, 0)) for each in manifest.models.values()):
                raise MalformedError(f"{name} is not a finite number")
        if not all(map(str.isprintable, (manifest.name, manifest.task, manifest.preprocessing))):
            raise MalformedError("a name holds control characters")
        if manifest.world.actions.actions != manifest.actions:
            raise MalformedError("its world has another number of actions")
    except DamagedArchiveError:
        raise
    except (ValueError, TypeError, KeyError, MalformedError, RecursionError) as error:
        raise BundleError(f"{path}: the manifest cannot be read ({error})") from error
    return manifest


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and bool(np.isfinite(value))
