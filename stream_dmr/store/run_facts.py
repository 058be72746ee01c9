"""Facts of a run, as lengths.db and provenance.json hold them."""

from dataclasses import dataclass
from hashlib import sha256
from typing import Any

from stream_dmr.recording.header import RunHeader
from stream_dmr.version import __version__

# Values of `ended_by`; beside these "an error: ..." with the error's line.
SOURCE_ENDED = "the end of the source"
SOURCE_CUT_OFF = "the source, which is damaged or cut off there"
STOPPED = "a stop before the end of the source"
ENDLESS_STOPPED = "a stop; the source has no end"
NOT_ENDED = "nothing so far: it goes on, or a crash ended it"
# The columns of `runs` that a run writes at its end.
END_COLUMNS = ("ended_ns", "ended_by", "frames_done", "frames_promised")


@dataclass(frozen=True, kw_only=True)
class RunFacts:
    """The facts of one run, a column of `runs` each. Hashes are SHA-256 in hex; "" if missing."""

    source: str
    command: str
    software_version: str
    config_sha256: str
    calibration_sha256: str
    template_sha256: str
    source_path: str = ""  # the files that the run was given, see `RunInputs`
    source_sha256: str = ""
    boxes_path: str = ""
    boxes_sha256: str = ""
    masks_path: str = ""
    masks_sha256: str = ""
    calibration_path: str = ""
    nmea_path: str = ""
    nmea_sha256: str = ""
    species_model_path: str = ""
    species_model_sha256: str = ""
    vessel: str = ""
    trip: str = ""
    haul: str = ""
    ended_by: str = ""  # "" by an older stream-dmr
    frames_done: int | None = None  # that went through the whole chain
    frames_promised: int | None = None  # by the source; of a camera: that came; None: unknown
    utc_zero_ns: int | None = None  # added to capture times gives UTC since 1970; None: unknown


def cut_short(facts: RunFacts) -> str:
    """The share of its source that a run measured, and why it ended; "" if that is all of it."""
    done, promised = facts.frames_done, facts.frames_promised
    # A container's number of frames, duration x rate, may be 1 too many.
    is_whole = done is None or promised is None or done >= promised - 1
    if not facts.ended_by or (is_whole and facts.ended_by in (SOURCE_ENDED, ENDLESS_STOPPED)):
        return ""
    if done is not None and promised:
        if is_whole and facts.ended_by == STOPPED:
            return ""
        share = f"{done} of {promised} frames ({100 * done / promised:.0f} %)"
    else:
        share = f"{'an unknown number of' if done is None else done} frames"
    return f"{share} of {facts.source} were measured; what ended the run: {facts.ended_by}"


def run_facts(header: RunHeader) -> RunFacts:
    """The facts that a header has of its run; each hash is of the bytes of the recording."""
    parts = header.attachments()
    hashes = {name: sha256(data).hexdigest() for name, data in parts.items()}
    given = {} if header.inputs is None else header.inputs.metadata()
    facts: dict[str, Any] = {
        **given,
        "source": header.source,
        "command": header.command,
        "software_version": __version__,
        "config_sha256": hashes["config.toml"],
        "calibration_sha256": hashes.get("calibration.yaml", ""),
        "template_sha256": hashes["template.pb"],
    }
    return RunFacts(**facts)
