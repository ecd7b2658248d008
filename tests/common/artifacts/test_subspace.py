import json

import numpy as np
import pytest

from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.artifacts.subspace import SearchSpace, Subspace
from dreamfleet.common.errors import UsageError

SHAPES = [ControllerShape(5, 2), ControllerShape(5, 2, hidden=3)]


@pytest.fixture
def subspace():
    random = np.random.default_rng(1)
    weights, offsets = (random.normal(size=size).astype(np.float32) for size in ((3, 5), 3))
    return Subspace(weights, offsets, ("left", "right", "reward"), "ab" * 32)


@pytest.mark.parametrize("shape", SHAPES)
def test_coordinates_are_weights_of_the_features(subspace, shape):
    random, space = np.random.default_rng(2), SearchSpace(subspace, shape)
    origin, coordinates = random.normal(size=shape.size), random.normal(size=(4, space.dimension))
    seen = random.normal(size=5)
    before, lifted = shape.unpack(origin), shape.unpack(space.lift(origin, coordinates))
    features = np.append(subspace.weights.astype(np.float64) @ seen + subspace.offsets, 1)
    outputs = shape.layers[0][0]
    own = coordinates[:, : 4 * outputs].reshape(4, outputs, 4)
    first = lifted[0][0] @ seen + lifted[0][1]
    np.testing.assert_allclose(first, before[0][0] @ seen + before[0][1] + own @ features, rtol=1e-10)
    if shape.hidden:  # layers behind the first are all free
        rest = coordinates[:, 4 * outputs :]
        np.testing.assert_allclose(
            np.concatenate([each.reshape(4, -1) for each in lifted[1]], axis=1),
            np.concatenate([each.ravel() for each in before[1]]) + rest,
        )


@pytest.mark.parametrize("shape", SHAPES)
def test_zero_coordinates_are_the_origin_and_rows_are_independent(subspace, shape):
    space, random = SearchSpace(subspace, shape), np.random.default_rng(3)
    origin, coordinates = random.normal(size=shape.size), random.normal(size=(9, space.dimension))
    assert (space.lift(origin, np.zeros(space.dimension)) == origin).all()
    together = space.lift(origin, coordinates)
    assert all((space.lift(origin, each) == row).all() for each, row in zip(coordinates, together, strict=True))


def test_text_and_file_round_trip(subspace, tmp_path):
    path = tmp_path / "few.npz"
    subspace.save(path, {"drives": 3})
    for again in (Subspace.from_text(subspace.text), Subspace.load(path)):
        assert (again.weights == subspace.weights).all()
        assert (again.names, again.bundle, again.sha256) == (subspace.names, subspace.bundle, subspace.sha256)
    moved = subspace.weights.copy()
    moved[0, 0] = np.nextafter(moved[0, 0], 9, dtype=np.float32)
    assert Subspace(moved, subspace.offsets, subspace.names, subspace.bundle).sha256 != subspace.sha256


@pytest.mark.parametrize(
    "changes",
    [
        {"weights": np.zeros((0, 5), np.float32)},
        {"weights": np.zeros(5, np.float32)},
        {"weights": np.full((3, 5), np.nan, np.float32)},
        {"weights": np.full((3, 5), 2e6, np.float32)},
        {"weights": np.zeros((3, 1 << 18), np.float32)},
        {"weights": np.zeros((3, 5))},
        {"offsets": np.zeros(2, np.float32)},
        *({"about": {"names": names}} for names in (["a", "b"], ["a", "b", "c" * 200], ["a", "b", 3], 3, "abc")),
        {"about": {"bundle": ""}},
        *({"about": {"format": form}} for form in (2, True, "x" * 5000)),
    ],
)
def test_an_invalid_subspace_is_a_one_line_error(subspace, tmp_path, changes):
    about = {"format": 1, "names": ["a", "b", "c"], "bundle": "ab"} | changes.pop("about", {})
    arrays = {"weights": subspace.weights, "offsets": subspace.offsets, **changes}
    path = tmp_path / "bad.npz"
    np.savez(path, **arrays, about=json.dumps(about))
    with pytest.raises(UsageError, match=r"bad\.npz") as raised:
        Subspace.load(path)
    assert "\n" not in str(raised.value)


def test_damaged_files_and_texts_are_errors(tmp_path):
    path = tmp_path / "bad.npz"
    for content in (None, b"", b"rubbish", b"PK\x03\x04"):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(UsageError, match=r"bad\.npz"):
            Subspace.load(path)
    for text in ("", "[]", "{}", "nothing", '{"weights": "é"}', "[" * 100_000):
        with pytest.raises(ValueError):  # who keeps it says which file it is
            Subspace.from_text(text)
