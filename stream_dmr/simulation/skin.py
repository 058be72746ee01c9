"""The skin of a simulated halibut: a mottled eyed side and a pale blind side.

Colours and marks were chosen by eye.
"""

import cv2
import numpy as np
from jaxtyping import Float, Float32

_ALONG, _ACROSS = 384, 160  # texture pixels from snout to tail, and across the broad side
_EYED_BGR = np.array([62.0, 82.0, 92.0], np.float32)
_BLIND_BGR = np.array([205.0, 214.0, 218.0], np.float32)
_SKIN = 7  # key of a stream of random numbers; `rail_scene` and `film` have the others


def draw_skin(*, seed: int, track_id: int) -> Float32[np.ndarray, "2 S Y 3"]:
    """Textures of the eyed and the blind side, BGR; rows from snout to tail, columns across."""
    rng = np.random.default_rng((seed, _SKIN, track_id))
    return np.stack([_eyed_side(rng), _blind_side(rng)])


def noise(
    rng: np.random.Generator, height: int, width: int, *, grain_px: tuple[float, float]
) -> Float32[np.ndarray, "H W"]:
    """Smooth noise of unit variance with a grain of this size along x and along y."""
    shrink = max(
        1, int(min(grain_px) / 3)
    )  # coarse noise is blurred at low resolution, which is faster
    white = rng.standard_normal((height // shrink + 1, width // shrink + 1), dtype=np.float32)
    smooth = cv2.GaussianBlur(white, (0, 0), grain_px[0] / shrink, sigmaY=grain_px[1] / shrink)
    smooth = cv2.resize(smooth, (width, height), interpolation=cv2.INTER_CUBIC)
    return (smooth - smooth.mean()) / smooth.std()


def _eyed_side(rng: np.random.Generator) -> Float32[np.ndarray, "S Y 3"]:
    s, y = _grid()
    tone = 1 + 0.20 * _noise(rng, 14.0) + 0.12 * _noise(rng, 5.0) + 0.08 * _noise(rng, 1.5)
    tone *= rng.uniform(0.8, 1.25)
    tone += 0.45 * np.clip(_noise(rng, 5.0) - 1.6, 0.0, 1.0)  # pale spots
    tone *= _fins(s, y) * _lateral_line(s, y)
    tone *= 1 - 0.35 * _arc(s, y, 0.215)  # the gill cover
    side = tone[..., None] * _EYED_BGR * rng.uniform(0.92, 1.08, 3).astype(np.float32)
    for eye_s, eye_y in ((0.075, 0.30), (0.11, -0.22)):
        _draw_eye(side, eye_s, eye_y)
    return np.clip(side, 8, 255).astype(np.float32)


def _blind_side(rng: np.random.Generator) -> Float32[np.ndarray, "S Y 3"]:
    s, y = _grid()
    tone = 1 + 0.035 * _noise(rng, 12.0) + 0.02 * _noise(rng, 2.0)
    tone *= 1 - 0.10 * (1 - _fins(s, y)) - 0.2 * _arc(s, y, 0.215)
    side = tone[..., None] * _BLIND_BGR
    blood = np.clip(_noise(rng, 9.0) - 1.3, 0.0, 1.0)[..., None]  # red blotches, as on hauled fish
    side *= 1 - blood * np.array([0.22, 0.20, 0.02], np.float32)
    return np.clip(side, 8, 255).astype(np.float32)


def _grid() -> tuple[Float32[np.ndarray, "S 1"], Float32[np.ndarray, "1 Y"]]:
    s = np.linspace(0.0, 1.03, _ALONG, dtype=np.float32)[:, None]
    y = np.linspace(-1.0, 1.0, _ACROSS, dtype=np.float32)[None]
    return s, y


def _noise(rng: np.random.Generator, grain: float) -> Float32[np.ndarray, "S Y"]:
    # The texture is about as dense across as along where the body is broad.
    return noise(rng, _ALONG, _ACROSS, grain_px=(grain, grain))


def _fins(s: Float[np.ndarray, "S 1"], y: Float[np.ndarray, "1 Y"]) -> Float[np.ndarray, "S Y"]:
    """Darker where the long fins fringe the body, and rays in the tail fin."""
    fringe = 1 / (1 + np.exp(-(np.abs(y) - 0.78) / 0.03)) * ((s > 0.2) & (s < 0.86))
    rays = 0.12 * (np.sin(40 * y) > 0) * (s > 0.9) + 0.15 * (s > 0.9)
    return 1 - 0.28 * fringe - rays


def _lateral_line(
    s: Float[np.ndarray, "S 1"], y: Float[np.ndarray, "1 Y"]
) -> Float[np.ndarray, "S Y"]:
    """Straight along the middle, with the arch over the pectoral fin that halibut have."""
    arch = 0.28 * np.exp(-(((s - 0.30) / 0.06) ** 2))
    return 1 - 0.30 * np.exp(-(((y - arch) / 0.02) ** 2)) * ((s > 0.2) & (s < 0.9))


def _arc(
    s: Float[np.ndarray, "S 1"], y: Float[np.ndarray, "1 Y"], at: float
) -> Float[np.ndarray, "S Y"]:
    return np.exp(-(((s - at + 0.05 * y**2) / 0.006) ** 2)) * (np.abs(y) < 0.8)


def _draw_eye(side: Float[np.ndarray, "S Y 3"], s: float, y: float) -> None:
    center = (round((y + 1) / 2 * (_ACROSS - 1)), round(s / 1.03 * (_ALONG - 1)))
    # Wider across, since the texture is compressed there: the head is narrow.
    cv2.ellipse(side, center, (11, 5), 0, 0, 360, (70, 105, 110), -1, cv2.LINE_AA)
    cv2.ellipse(side, center, (6, 3), 0, 0, 360, (12, 12, 14), -1, cv2.LINE_AA)
