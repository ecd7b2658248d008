"""The frozen world model: ONNX Runtime for inference; torch modules and the export stand apart."""
