"""What made the lengths of a run: its inputs and settings, as lengths.db and provenance have it."""

from dataclasses import dataclass
from hashlib import sha256

from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.version import __version__


@dataclass(frozen=True, kw_only=True)
class RunFacts:
    """The facts of one run; hashes are SHA-256 in hex; "" where there is none."""

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
    vessel: str = ""
    trip: str = ""
    haul: str = ""


def run_facts(header: RunHeader, *, vessel: str = "", trip: str = "", haul: str = "") -> RunFacts:
    """The facts of the run with this header; each hash is of the bytes that the recording holds."""
    parts = header.attachments()
    hashes = {name: sha256(data).hexdigest() for name, data in parts.items()}
    given = {} if header.inputs is None else header.inputs.metadata()
    facts = {
        "source": header.source,
        "command": header.command,
        "software_version": __version__,
        "config_sha256": hashes["config.toml"],
        "calibration_sha256": hashes.get("calibration.yaml", ""),
        "template_sha256": hashes["template.pb"],
        "vessel": vessel,
        "trip": trip,
        "haul": haul,
    }
    return RunFacts(**given | facts)
