"""Time matrix products alone in each installed library: the fastest of each makes up the lower bound of a step's time.

With one library alone, a step would look better wherever that library is slow on the processor or configured to be.
"""

from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dreamfleet.worker.addons.bench.measurement import TimedCall
from dreamfleet.worker.worldmodel.inference import open_graph

Floats = NDArray[np.float32]
Size = tuple[tuple[int, ...], tuple[int, ...]]  # of the left and the right matrix, or of stacks of them
NEEDED = {"onnxruntime": ("onnxruntime", "onnx")}  # packages; `onnx` writes the graph of a product


def product_cases(sizes: Sequence[Size]) -> dict[str, TimedCall]:
    """Calls that multiply random matrices of these sizes with NumPy and, if installed, ONNX Runtime and torch."""
    random = np.random.default_rng(0)
    cases: dict[str, TimedCall] = {}
    for index, size in enumerate(sizes):
        left, right = (random.normal(size=shape).astype(np.float32) for shape in size)
        for library, make in LIBRARIES.items():
            if all(map(find_spec, NEEDED.get(library, (library,)))):
                cases[_case(index, library)] = make(left, right)
    return cases


def fastest(seconds: dict[str, float], count: int) -> tuple[float, tuple[str, ...]]:
    """The summed seconds of `count` products, each in the library that was fastest at it, and those libraries."""
    best = [
        min((seconds[case], library) for library in LIBRARIES if (case := _case(index, library)) in seconds)
        for index in range(count)
    ]
    return sum(time for time, _ in best), tuple(library for _, library in best)


def _case(index: int, library: str) -> str:
    return f"product {index} by {library}"


def _by_numpy(left: Floats, right: Floats) -> TimedCall:
    out = left @ right
    return lambda: np.matmul(left, right, out=out)


def _by_torch(left: Floats, right: Floats) -> TimedCall:
    torch: Any = import_module("torch")
    torch.set_num_threads(1)
    first, second = torch.from_numpy(left), torch.from_numpy(right)
    out = torch.matmul(first, second)
    return lambda: torch.matmul(first, second, out=out)


def _by_onnxruntime(left: Floats, right: Floats) -> TimedCall:
    """Multiply with the right matrix as a weight, as in a model: the runtime packs it once."""
    session = open_graph(product_graph(left.shape, right), threads=1)
    binding, out = session.io_binding(), left @ right
    binding.bind_cpu_input("left", left)
    binding.bind_output("out", "cpu", 0, np.float32, out.shape, out.ctypes.data)
    binding.kept = (left, out)  # what it points at
    return lambda: session.run_with_iobinding(binding)


LIBRARIES = {"numpy": _by_numpy, "torch": _by_torch, "onnxruntime": _by_onnxruntime}


def product_graph(left: tuple[int, ...], right: Floats) -> bytes:
    """An ONNX model of `out = left @ right`."""
    from onnx import TensorProto

    from dreamfleet.worker.worldmodel.onnx_graph import GraphBuilder

    graph = GraphBuilder("product")
    product = graph.node("MatMul", graph.add_input("left", TensorProto.FLOAT, *left[1:]), graph.constant(right))
    graph.add_output(product, "out", TensorProto.FLOAT, *left[1:-1], right.shape[-1])
    return graph.build()
