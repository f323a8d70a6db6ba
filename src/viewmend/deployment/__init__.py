"""A model outside of Python: `SweepNet` as an AOTInductor package or as ONNX, with sizes that may differ."""
