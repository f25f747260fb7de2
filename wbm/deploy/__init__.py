"""Bundle format and torch-free runtime: a policy that a roboticist can trust (NumPy and onnxruntime only)."""
