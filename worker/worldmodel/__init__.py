"""The world model: frozen in ONNX Runtime for inference, as torch modules for training, and the export between them."""
