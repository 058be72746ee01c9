"""The U-Net and sessions of ONNX models."""
