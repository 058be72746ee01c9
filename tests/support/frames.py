"""Frames, pictures and cameras that the tests of segmentation share."""

import cv2
import numpy as np
from hypothesis import strategies as st

from stream_dmr.camera import Camera
from stream_dmr.messages import Frame


def frame_of(image: np.ndarray, index: int = 1) -> Frame:
    return Frame(frame_index=index, timestamp_ns=index, image=image, source="test")


def grey_frame(camera: Camera, level: int = 128) -> Frame:
    return frame_of(np.full((camera.height, camera.width, 3), level, np.uint8))


def ellipse_mask(
    *,
    size: tuple[int, int] = (160, 120),
    center: tuple[int, int] = (80, 60),
    axes: tuple[int, int] = (50, 14),
    angle: float = 20.0,
) -> np.ndarray:
    """1 inside an ellipse; `size` is (width, height)."""
    mask = np.zeros(size[::-1], np.uint8)
    cv2.ellipse(mask, center, axes, angle, 0, 360, 1, cv2.FILLED)
    return mask


def texture(seed: int, *, width: int = 640, height: int = 480, grain: float = 3.0) -> np.ndarray:
    """A rock face: coloured noise."""
    rng = np.random.default_rng(seed)
    layers = rng.normal(0, 1, (height, width, 3)).astype(np.float32)
    layers = cv2.GaussianBlur(layers, (0, 0), grain)
    return np.clip(110 + 30 * layers / layers.std(), 0, 255).astype(np.uint8)


PAN_SIZE = (320, 240)


def pan(seed: int, step: tuple[float, float], frames: int) -> list[np.ndarray]:
    """Pictures of PAN_SIZE by a camera that moves by `step` px a frame before a rock face."""
    wall = texture(seed)
    pictures = []
    for i in range(frames):
        affine = np.array([[1.0, 0.0, -100 - i * step[0]], [0.0, 1.0, -100 - i * step[1]]])
        pictures.append(cv2.warpAffine(wall, affine, PAN_SIZE, borderMode=cv2.BORDER_REFLECT))
    return pictures


lens_cameras = st.builds(
    lambda f, x, y, k1, k2, p: Camera(
        width=640,
        height=480,
        K=np.array([[f, 0.0, 320 + x], [0.0, 1.02 * f, 240 + y], [0.0, 0.0, 1.0]]),
        distortion=np.array([k1, k2, p, -p, 0.0]),
    ),
    st.floats(500, 1500),
    st.floats(-20, 20),
    st.floats(-20, 20),
    st.floats(-0.25, 0.25),
    st.floats(0.0, 0.05),
    st.floats(-0.002, 0.002),
)
