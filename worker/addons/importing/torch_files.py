"""Checkpoints of `torch.save`, by torch's reader of weights: it calls nothing that a file names."""

from __future__ import annotations

import codecs
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from dreamfleet.common.errors import DatasetError
from dreamfleet.common.files.archives import ArchiveLimits, DamagedArchiveError, open_archive
from dreamfleet.common.files.regular_files import read_regular
from dreamfleet.common.printable import one_line

LIMITS = ArchiveLimits(512 << 20, members=4096, zip64=True)  # a VAE with its optimiser's state has 52 MB and 80 members
ZIP_MARK = b"PK\3\4"
_SCALAR: Any = np.dtype(float).type(0).__reduce__()[0]
# NumPy's numbers, which stand beside the weights: a score, for example. NumPy 1 called their module otherwise.
NUMBERS = [
    _SCALAR, (_SCALAR, "numpy.core.multiarray.scalar"), (_SCALAR, "numpy._core.multiarray.scalar"),
    (codecs.encode, "_codecs.encode"), np.dtype, *(type(np.dtype(kind)) for kind in ("f4", "f8", "i4", "i8")),
]  # fmt: skip
_REFUSED = re.compile(r"GLOBAL (\S+)")


def read_torch_file(path: Path) -> Any:
    """What a file of `torch.save` holds; `DatasetError` if it is none, is too large, or holds more than numbers."""
    try:
        data = read_regular(path, LIMITS.size)
        if data.startswith(ZIP_MARK):
            with open_archive(io.BytesIO(data), LIMITS) as archive:  # it may be larger when torch unpacks it
                if not any(name.endswith("data.pkl") for name in archive.names):
                    raise DamagedArchiveError("it is a zip without the data.pkl of torch.save")
        with torch.serialization.safe_globals(NUMBERS):
            return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise DatasetError(f"no file at {path}") from None
    except Exception as error:  # whatever torch meets in a damaged file
        if named := _REFUSED.search(str(error)):
            what = f"it names {named[1][:80]}, which no checkpoint of numbers holds. Nothing was executed"
            raise DatasetError(f"{path} was not read: {what}") from error
        reason = one_line(str(error))[:200]
        raise DatasetError(f"{path} is no file of torch.save that can be read ({reason})") from error


def array_of(tensor: torch.Tensor, path: Path) -> NDArray[np.float32]:
    """The numbers of a tensor; `DatasetError` for one that repeats the few numbers of its file many times."""
    if tensor.layout != torch.strided or tensor.is_meta or tensor.is_neg() or tensor.is_complex():
        raise DatasetError(f"{path}: a tensor of {tuple(tensor.shape)} is not stored as plain numbers")
    if tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
        raise DatasetError(f"{path}: a tensor of {tuple(tensor.shape)} has more numbers than the file")
    return np.array(tensor.detach().to(torch.float32).numpy())
