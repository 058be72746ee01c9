"""How this machine rounds: BLAS, LAPACK and the math library choose code by the processor."""

import zlib
from functools import cache

import numpy as np


@cache
def arithmetic_checksum() -> str:
    """CRC-32 of the bits of fixed sums, products, solutions and functions, as hexadecimal digits.

    Where it differs, so may the last bits of results, with equal versions of everything: OpenBLAS
    for one has other kernels for AVX2 than for AVX-512, and OPENBLAS_CORETYPE overrides its choice.
    """
    values = np.modf(np.arange(1, 145) * np.sqrt(2.0))[0]
    A, b = values.reshape(12, 12), values[:12]
    parts = [
        A @ A,
        A @ b,
        A[:3, :3] @ b[:3],
        np.linalg.solve(A, b),
        np.linalg.lstsq(A[:, :2], b, rcond=None)[0],
        np.linalg.inv(A),
        np.exp(A),
        np.sin(A),
        np.array([A.sum(), np.linalg.norm(A)]),
    ]
    return f"{zlib.crc32(b''.join(part.tobytes() for part in parts)):08x}"
