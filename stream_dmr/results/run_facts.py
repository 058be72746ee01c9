"""What the results say of the run that measured them."""

from hashlib import sha256

from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.results.store import RunFacts
from stream_dmr.version import __version__


def run_facts(header: RunHeader, *, vessel: str = "", trip: str = "", haul: str = "") -> RunFacts:
    """What the store says of a run; each hash is of the bytes that the recording holds."""
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
