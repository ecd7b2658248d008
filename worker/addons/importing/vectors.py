"""Parameter vectors of other programs: JSON of the paper's and the article's code, NumPy, text, pycma's output.

Pages: ask-tell.md.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.common.artifacts.bundle import Bundle
from dreamfleet.common.artifacts.controller import ControllerShape
from dreamfleet.common.errors import ControllerError, DatasetError
from dreamfleet.common.files.archives import parse_array
from dreamfleet.common.files.regular_files import read_regular, read_text
from dreamfleet.common.printable import truncate
from dreamfleet.worker.addons.importing.json_weights import read_json

MOST_BYTES = 512 << 20
MOST_TEXT = 64 << 20
CMA_COLUMNS = 5  # generation, evaluations, and three figures, before the vector in `xrecentbest.dat` and `xmean.dat`
CMA_FILES = ("xmean.dat", "xrecentbest.dat")


def read_vector(path: Path) -> NDArray[np.float64]:
    """The flat vector of a file or of pycma's output folder; `DatasetError` says why there is none.

    `.json`: a list of numbers, or one whose first element is that. `.npy`: one axis. `.csv`, `.txt`: numbers separated
    by commas or blanks in one row, or one a line. A folder, or a `.dat` of it: the last row that pycma's logger wrote.
    """
    if path.is_dir():
        found = next((path / name for name in CMA_FILES if (path / name).is_file()), None)
        if found is None:
            raise DatasetError(f"{path} holds none of {', '.join(CMA_FILES)}, which pycma's logger writes")
        path = found
    readers = {".json": _from_json, ".npy": _from_npy, ".csv": _from_text, ".txt": _from_text, ".dat": _from_pycma}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise DatasetError(f"{path}: a vector is a file {', '.join(readers)}, or a folder that pycma wrote")
    try:
        vector = reader(path)
    except (OSError, ValueError, IndexError, OverflowError) as error:
        raise DatasetError(f"{path} holds no vector of numbers ({error})") from error
    if vector.ndim != 1 or not len(vector):
        raise DatasetError(f"{path} holds an array of shape {vector.shape}, not one vector")
    if not (np.abs(vector) <= np.finfo(np.float32).max).all():
        raise DatasetError(f"{path} holds NaN, infinity, or a number that is too large for single precision")
    return vector


def to_parameters(vector: NDArray[Any], layout: str, shape: ControllerShape) -> NDArray[np.float32]:
    """The parameters `(size,)` of a controller whose vector has this layout; `ControllerError` if it cannot fit.

    The layout is `dreamfleet`, `wme`, `article` or `ctallec`, as docs/reference/import.md says.

    >>> to_parameters(np.array([9.0, 1, 2, 3]), "wme", ControllerShape(features=3, actions=1)).tolist()
    [1.0, 2.0, 3.0, 9.0]
    """
    vector = vector.astype(np.float32)
    shape.check(vector)
    if layout in ("dreamfleet", "ctallec"):
        return vector
    if shape.hidden:
        raise ControllerError(
            f"the layout {layout} is of linear controllers, and this one has {shape.hidden} hidden units"
        )
    count = shape.actions
    biases, weights = (vector[:count], vector[count:]) if layout == "wme" else (vector[-count:], vector[:-count])
    return np.concatenate([weights.reshape(shape.features, count).T.ravel(), biases])


def sees_cells(bundle: Bundle) -> bool:
    """Whether a bundle's controllers see the LSTM's cells too, as those of WME's Doom do."""
    units: int = bundle.manifest.models.get("mdnrnn", {}).get("hidden", 0)
    return bundle.manifest.hidden == 2 * units


def with_units(vector: NDArray[np.float64], bundle: Bundle) -> NDArray[np.float64]:
    """A vector of WME's Doom as one of the layout `wme` for its bundle; `ControllerError` for another size.

    It weights latent, cells and hidden state, without a bias. A bundle has the cells last, and a unit more of each.
    """
    latent, units = bundle.manifest.latent, bundle.manifest.hidden // 2 - 1
    if len(vector) != latent + 2 * units:
        raise ControllerError(f"it has {len(vector)} numbers, and a controller of {bundle.path} {latent + 2 * units}")
    seen, cells, hidden = np.split(vector, [latent, latent + units])
    return np.concatenate([[0], seen, hidden, [0], cells, [0]])


def _from_json(path: Path) -> NDArray[np.float64]:
    value = read_json(path)
    if isinstance(value, list) and value and isinstance(value[0], list):
        if any(isinstance(each, list) for each in value[1:]):
            raise ValueError("it has several lists: keep one")
        value = value[0]  # the vector, then what it scored
    if not isinstance(value, list) or not all(type(each) in (int, float) for each in value):
        raise ValueError("it is no list of numbers")
    return np.array(value, np.float64)


def _from_npy(path: Path) -> NDArray[np.float64]:
    found = parse_array(read_regular(path, MOST_BYTES), path.name)
    if found.dtype.kind not in "iuf":
        raise ValueError(f"they are of type {found.dtype}")
    return found.astype(np.float64)


def _from_text(path: Path) -> NDArray[np.float64]:
    text = re.sub(r",\s*\n", ", ", read_text(path, MOST_TEXT))  # a line that ends in a comma goes on
    rows = [_numbers(line) for line in text.splitlines() if line.strip()]
    if len(rows) > 1 and any(len(each) > 1 for each in rows):
        raise ValueError(f"it has {len(rows)} rows: a vector is one row, or a number a line")
    return np.array([number for row in rows for number in row])


def _numbers(line: str) -> list[float]:
    """The numbers of a line, separated by commas or blanks; `ValueError` for anything else."""
    if "_" in line:  # which Python skips
        raise ValueError(f"{truncate(line, 40)!r} has an underscore")
    fields = line.strip().removesuffix(",").split(",")
    return [float(each) for field in fields for each in field.split() or [""]]


def _from_pycma(path: Path) -> NDArray[np.float64]:
    lines = [line for line in read_text(path, MOST_BYTES).splitlines() if line.strip() and line[0] not in "%#"]
    return np.array(_numbers(" ".join(lines[-1].split()[CMA_COLUMNS:])))
