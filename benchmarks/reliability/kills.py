"""kill -9 at random moments of a running measurement: what is left, and what the restart does."""

import random
import time
from pathlib import Path

from measured import Measurement

from stream_dmr.errors import RecordingError
from stream_dmr.messages import Frame
from stream_dmr.recording.codec import decode
from stream_dmr.recording.opened import Recording, open_recordings


def kills(folder: Path, scene: Path, *, count: int, seed: int = 0) -> dict[str, object]:
    """Kill `count` times, each some moments after the first fish of the run; figures."""
    rng = random.Random(seed)
    run = Measurement(folder, scene, fps=8)
    run.camera.start()
    unreadable, lost_s = 0, []
    try:
        for _ in range(count):
            known = len(run.events("fish"))
            run.start()
            run.wait_for("fish", more_than=known)
            time.sleep(rng.uniform(0, 4))
            assert run.process is not None
            run.process.kill()
            run.process.wait()
            killed_ns = time.time_ns()
            try:
                lost_s.append((killed_ns - last_message_ns(run.out)) / 1e9)
            except RecordingError:
                unreadable += 1
        stored = run.fish()
    finally:
        run.camera.lose()
    said = [line["track_id"] for line in run.events("fish")]
    return {
        "kills": count,
        "fish": len(stored),
        "finished fish lost": len(set(said) - set(stored)),
        "ids used twice": len(said) - len(set(said)),
        "recordings that can't be read": unreadable,
        "recorded until, s before the kill, most": round(max(lost_s, default=0.0), 2),
    }


def last_message_ns(out: Path) -> int:
    """The capture time of the newest message in the recording that was being written."""
    newest = max(out.glob("*.mcap*"), key=lambda path: path.stat().st_mtime_ns)
    recording = open_recordings([newest])
    return max(time_ns for time_ns in times_of(recording))


def times_of(recording: Recording) -> list[int]:
    """The capture times of all its frames."""
    return [decode(kind, payload).timestamp_ns for kind, payload in recording.payloads([Frame])]
