"""A user's classifier of crops as an ONNX file: pictures of fish in, species out.

Input: (1 or N, 3, H, W), RGB from 0 to 1, the crop as it is cut out. Output: (1 or N, C), logits of
C species. The FAO codes of these species stand in the model's metadata as `species`, joined by
commas, and perhaps a `temperature` by which logits are divided; or in a TOML of the same name
beside it, as `species = ["HAP", "COD"]` and `temperature = 1.5`.
"""

import tomllib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from stream_dmr.errors import ModelError, first_line, reason_of
from stream_dmr.files import read_text
from stream_dmr.messages import FishCrop
from stream_dmr.networks.onnx_session import open_session
from stream_dmr.species import CODE

_DEFAULT_SIDE_PX = 128  # that of a crop, for a model that takes pictures of any size
_MIN_VISIBLE = 0.5  # of a fish that is classified; chosen


class SpeciesClassifier:
    """Says of a crop which species it shows."""

    def __init__(self, path: Path) -> None:
        """Raises ModelError for a file that is no such model; it is tried on a picture."""
        self._path = path
        self._session = open_session(path)
        self.codes, self._temperature = self._read_classes()
        inputs = self._session.get_inputs()
        shape = list(inputs[0].shape)
        if len(inputs) != 1 or len(shape) != 4 or shape[1] != 3:
            raise self._refusal("one input (1, 3, H, W)", ", ".join(str(i.shape) for i in inputs))
        self._input: str = inputs[0].name
        sides = [side if isinstance(side, int) else _DEFAULT_SIDE_PX for side in shape[2:]]
        self._height, self._width = sides
        self._try()

    def classify(self, crop: FishCrop) -> dict[str, float]:
        """The probability of each species by its code; empty of a fish that is hardly seen."""
        image = crop.image
        if image is None or not crop.mask.any() or crop.quality.visible_fraction < _MIN_VISIBLE:
            return {}
        logits = self._logits(image).astype(np.float64) / self._temperature
        weights = np.exp(logits - logits.max())
        return dict(zip(self.codes, (weights / weights.sum()).tolist(), strict=True))

    def _logits(self, image: UInt8[np.ndarray, "S S 3"]) -> Float32[np.ndarray, "C"]:
        is_smaller = self._width < image.shape[1]
        interpolation = cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR
        picture = cv2.resize(image, (self._width, self._height), interpolation=interpolation)
        rgb = picture[..., ::-1].transpose(2, 0, 1)[None].astype(np.float32) / 255
        (logits, *_) = self._session.run(None, {self._input: np.ascontiguousarray(rgb)})
        return np.asarray(logits, np.float32).reshape(-1)

    def _read_classes(self) -> tuple[list[str], float]:
        """The codes in the order of the outputs, and the temperature."""
        values: dict[str, Any] = dict(self._session.get_modelmeta().custom_metadata_map)
        toml = self._path.with_suffix(".toml")
        if toml.exists():
            try:
                values |= tomllib.loads(read_text(toml))
            except (OSError, ValueError) as error:
                raise ModelError(f"{toml}: expected TOML, got: {reason_of(error)}") from error
        codes = values.get("species", [])
        codes = codes.split(",") if isinstance(codes, str) else codes
        if (
            not isinstance(codes, list)
            or len(codes) < 2
            or not all(isinstance(code, str) and CODE.fullmatch(code) for code in codes)
            or len(set(codes)) < len(codes)
        ):
            raise self._refusal("the FAO codes of two or more species in its metadata", f"{codes}")
        try:
            temperature = float(values.get("temperature", 1.0))
        except (TypeError, ValueError):
            temperature = 0.0
        if not 0 < temperature < np.inf:
            raise self._refusal("a temperature above 0", f"{values['temperature']}")
        return [str(code) for code in codes], temperature

    def _try(self) -> None:
        try:
            logits = self._logits(np.full((64, 64, 3), 90, np.uint8))
        except Exception as error:  # onnxruntime's errors share no base class
            raise self._refusal("a model that takes one picture", first_line(error)) from None
        if len(logits) != len(self.codes) or not np.isfinite(logits).all():
            raise self._refusal(f"{len(self.codes)} finite logits", f"{len(logits)} numbers")

    def _refusal(self, expected: str, got: str) -> ModelError:
        return ModelError(
            f"{self._path}: expected {expected}, got {got}; docs/species.md says what a classifier "
            "looks like"
        )
