"""The files that `replay --from crop` reads: those that are given, else the run's own."""

from dataclasses import dataclass, replace
from pathlib import Path

from stream_dmr.errors import UserError
from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.recording.messages.run_inputs import InputFile, RunInputs


@dataclass(frozen=True, kw_only=True)
class CropFiles:
    """What a replay cuts crops out of."""

    source: str | None  # None: not found, for the reason in `missing_source`
    boxes: Path | None
    masks: Path | None
    missing_source: str = ""


def find_crop_files(
    header: RunHeader, *, source: str | None, boxes: Path | None, masks: Path | None
) -> CropFiles:
    """The given files; for a source, or for boxes and masks, that aren't given the run's own.

    Raises UserError, which asks for boxes or masks, where the run's are gone or changed, or where
    the recording is so old that it has no hash of them.
    """
    missing_source = ""
    if source is None:
        source, missing_source = _find_source(header)
    inputs = header.known_inputs
    if boxes is None and masks is None and inputs is not None:
        boxes, masks = _unchanged(inputs.boxes, "--boxes"), _unchanged(inputs.masks, "--masks")
    return CropFiles(source=source, boxes=boxes, masks=masks, missing_source=missing_source)


def inputs_with(
    recorded: RunInputs | None,
    *,
    source: str | None,
    boxes: Path | None,
    masks: Path | None,
    calibration: Path | None,
) -> RunInputs | None:
    """The recorded inputs, those that are given in the place of the recorded ones."""
    if recorded is None:
        return None
    given = {"source": source, "boxes": boxes, "masks": masks, "calibration": calibration}
    if boxes is not None or masks is not None:
        recorded = replace(recorded, boxes=None, masks=None)
    files = {name: InputFile.read(path) for name, path in given.items() if path is not None}
    return replace(recorded, **files)


def _find_source(header: RunHeader) -> tuple[str | None, str]:
    """The place of the run's source, or None and what to say of it.

    One without a hash is found by its place: each of its pictures has a checksum in the recording.
    """
    if header.inputs is None:
        return None, "give --source"
    source = header.inputs.source
    is_found = source.is_unchanged() if source.sha256 else source.exists()
    return (source.path, "") if is_found else (None, _complaint(source, "--source"))


def _unchanged(file: InputFile | None, option: str) -> Path | None:
    if file is None:
        return None
    if not file.sha256:
        raise UserError(
            "--from crop: expected boxes or masks of the fish, since the recording is too old "
            "to hold it; give the run's --boxes, --masks or both"
        )
    if not file.is_unchanged():
        raise UserError(f"--from crop: {_complaint(file, option)}")
    return Path(file.path)


def _complaint(file: InputFile, option: str) -> str:
    found = "other content, by its SHA-256" if file.exists() else "nothing"
    return f"expected the run's {option} at {file.path}, found {found} there; give {option}"
