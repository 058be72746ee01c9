"""kill -9 at random moments of a running measurement: what is left, and what the restart does."""

import random
import time
from pathlib import Path
from statistics import median

from mcap.exceptions import McapError
from mcap.reader import make_reader
from measured import Measurement

from stream_dmr.errors import RecordingError
from stream_dmr.messages import LocalizedFish
from stream_dmr.recording.codec import decode
from stream_dmr.recording.opened import open_recordings
from stream_dmr.recording.recover import recover


def kills(
    folder: Path, scene: Path, *, count: int, minutes: float = 1e9, seed: int = 0
) -> dict[str, object]:
    """Kill `count` times, each some moments after the first fish of the run; figures."""
    rng = random.Random(seed)
    run = Measurement(folder, scene, fps=8)
    run.camera.start()
    unreadable, lost_s, began = 0, [], time.monotonic()
    checked: set[Path] = set()
    num_kills = 0
    try:
        while num_kills < count and time.monotonic() - began < 60 * minutes:
            known, begun = len(run.events("fish")), len(run.events("begin"))
            run.start()
            run.wait_for("begin", more_than=begun)
            unreadable += unreadable_ones(run.out, checked)
            run.wait_for("fish", more_than=known)
            time.sleep(rng.uniform(0, 4))
            assert run.process is not None
            run.process.kill()
            run.process.wait()
            num_kills += 1
            try:
                lost_s.append((last_row_ns(run.out) - last_message_ns(run.out)) / 1e9)
            except RecordingError:
                unreadable += 1
        for _ in recover(run.out):
            pass
        unreadable += unreadable_ones(run.out, checked)
        stored, interrupted = run.fish(), run.interrupted()
    finally:
        run.camera.lose()
    said = [line["track_id"] for line in run.events("fish")]
    return {
        "kills": num_kills,
        "fish": len(stored),
        "of them in view at a kill, finished by the restart": interrupted,
        "segments": len(checked),
        "finished fish lost": len(set(said) - set(stored)),
        "ids used twice": len(said) - len(set(said)),
        "recordings that can't be read": unreadable,
        "recording ends before frames.csv, s, median": round(median(lost_s), 2),
        "recording ends before frames.csv, s, most": round(max(lost_s), 2),
    }


def unreadable_ones(out: Path, checked: set[Path]) -> int:
    """How many recordings, of those not yet checked, the mcap library's own reader refuses."""
    refused = 0
    for path in set(out.glob("*.mcap")) - checked:
        try:
            with path.open("rb") as stream:
                for _ in make_reader(stream, validate_crcs=True).iter_messages():
                    pass
        except (McapError, ValueError):
            refused += 1
        checked.add(path)
    return refused


def last_row_ns(out: Path) -> int:
    """The capture time of the last fish in frames.csv, which a kill leaves as it is: no fsync."""
    whole = (out / "frames.csv").read_text().rpartition("\n")[0]
    return int(whole.rpartition("\n")[2].split(",")[1])


def last_message_ns(out: Path) -> int:
    """The capture time of the last fish in the recordings that were being written."""
    recording = open_recordings(sorted(out.glob("*.mcap"))[-8:] + sorted(out.glob("*.part")))
    found = recording.payloads([LocalizedFish])
    return max((decode(kind, payload).timestamp_ns for kind, payload in found), default=0)
