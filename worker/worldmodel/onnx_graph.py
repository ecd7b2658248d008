"""Build ONNX graphs node by node."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
import onnx.utils
from numpy.typing import ArrayLike, NDArray
from onnx import TensorProto, helper, numpy_helper

OPSET = 17
IR_VERSION = 8
RUNTIME = "com.microsoft"  # domain of ONNX Runtime's own operators


class GraphBuilder:
    """Collects nodes and constants; each method returns the name of the value it adds."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[onnx.TensorProto] = []
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []

    def add_input(self, name: str, kind: int, *shape: int | str) -> str:
        """Add an input of type `kind` and shape `(N, *shape)`; a name in `shape` stands for any size."""
        self._inputs.append(helper.make_tensor_value_info(name, kind, ["N", *shape]))
        return name

    def add_scalar_input(self, name: str) -> str:
        """Add an input of one number `(1,)`."""
        self._inputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, [1]))
        return name

    def add_output(self, value: str, name: str, kind: int, *shape: int) -> None:
        """Make `value` an output `name` of type `kind` and shape `(N, *shape)`."""
        for node in self._nodes:  # rename the value itself: an Identity node would cost a copy
            for names in (node.input, node.output):
                names[:] = [name if each == value else each for each in names]
        self._outputs.append(helper.make_tensor_value_info(name, kind, ["N", *shape]))

    def constant(self, array: NDArray[Any]) -> str:
        """Add a constant."""
        name = f"c{len(self._constants)}"
        self._constants.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def numbers(self, values: ArrayLike) -> str:
        """Add a constant of numbers in single precision."""
        return self.constant(np.array(values, np.float32))

    def weight(self, array: NDArray[Any]) -> str:
        """Add a weight in half precision; the runtime widens it once, as it loads."""
        return self.node("Cast", self.constant(array.astype(np.float16)), to=TensorProto.FLOAT)

    def linear(self, value: str, kernel: NDArray[Any], bias: NDArray[Any] | None = None) -> str:
        """Multiply `value` by `kernel` (inputs, outputs) and add `bias`."""
        constants = [self.constant(each) for each in (kernel, bias) if each is not None]
        return self.node("Gemm", value, *constants)

    def split(self, value: str, *sizes: int) -> list[str]:
        """Split the columns of `value` into these sizes; a size of 0 gives an empty name."""
        real = [size for size in sizes if size]
        parts = [value] if len(real) == 1 else self._add("Split", [value, self.shape(*real)], len(real), axis=1)
        names = iter(parts)
        return [next(names) if size else "" for size in sizes]

    def join(self, *values: str) -> str:
        """Concatenate columns; empty names are left out."""
        real = [value for value in values if value]
        return self.node("Concat", *real, axis=1) if len(real) > 1 else real[0]

    def node(self, operator: str, *inputs: str, **attributes: Any) -> str:
        """Add an operator with one output."""
        return self._add(operator, inputs, 1, **attributes)[0]

    def _add(self, operator: str, inputs: Sequence[str], outputs: int, **attributes: Any) -> list[str]:
        names = [f"n{len(self._nodes)}_{index}" for index in range(outputs)]
        self._nodes.append(helper.make_node(operator, list(inputs), names, **attributes))
        return names

    def shape(self, *sizes: int) -> str:
        """Add a constant of integers: a shape, sizes or axes."""
        return self.constant(np.array(sizes, dtype=np.int64))

    def embed(self, model: onnx.ModelProto, given: Mapping[str, str], wanted: str) -> str:
        """Add what an output `wanted` of another model needs; `given` are the values of that model's inputs by name."""
        part = onnx.utils.Extractor(model).extract_model(list(given), [wanted]).graph
        names = {"": "", **given}
        for each in part.initializer:
            names[each.name] = f"c{len(self._constants)}"
            self._constants.append(onnx.TensorProto.FromString(each.SerializeToString()))
            self._constants[-1].name = names[each.name]
        for node in part.node:
            names |= {name: f"n{len(self._nodes)}_{index}" for index, name in enumerate(node.output)}
            self._nodes.append(onnx.NodeProto.FromString(node.SerializeToString()))
            self._nodes[-1].input[:] = [names[name] for name in node.input]
            self._nodes[-1].output[:] = [names[name] for name in node.output]
        return names[wanted]

    def build(self) -> bytes:
        """Serialise the model after ONNX's own check."""
        graph = helper.make_graph(self._nodes, self._name, self._inputs, self._outputs, self._constants)
        opsets = [helper.make_opsetid("", OPSET)]
        if any(node.domain == RUNTIME for node in self._nodes):
            opsets.append(helper.make_opsetid(RUNTIME, 1))
        model = helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION, producer_name="dreamfleet")
        onnx.checker.check_model(model, full_check=True)
        data: bytes = model.SerializeToString(deterministic=True)
        return data
