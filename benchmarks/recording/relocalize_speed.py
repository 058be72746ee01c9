"""A new calibration over a long recording: `replay --from localize`, in times real time.

    python -m benchmarks.recording.relocalize_speed RUN [--minutes 60]

RUN is the folder of a run with a calibration. Its recording is repeated, with frame numbers,
capture times and ids that go on, until it is so long; then the plane is moved by a centimetre.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from itertools import count, takewhile
from pathlib import Path

import numpy as np

from stream_dmr.calibration.calibration_file import save_calibration
from stream_dmr.messages import Frame, LengthEstimate, Message
from stream_dmr.recording.codec import encode, stored_picture
from stream_dmr.recording.mcap.mcap_sink import McapSink
from stream_dmr.recording.reading import Recording, decoded_messages, open_recordings
from stream_dmr.recording.record import Record
from stream_dmr.recording.topics import TOPICS


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    parser.add_argument("--minutes", type=float, default=60.0)
    arguments = parser.parse_args()
    run = open_recordings([arguments.run])
    calibration = run.header.calibration
    assert calibration is not None, "expected a run with a calibration"
    with tempfile.TemporaryDirectory() as scratch:
        long, moved = Path(scratch) / "long.mcap", Path(scratch) / "moved.yaml"
        with closing(McapSink(long, run.header, flush_s=10)) as sink:
            for record in repeated(run, minutes=arguments.minutes):
                sink.write(record)
        plane = replace(
            calibration.plane,
            translation_mm=calibration.plane.translation_mm + np.array([0.0, 0.0, 10.0]),
        )
        save_calibration(moved, replace(calibration, plane=plane))
        print(f"{long.stat().st_size / 1e6:.0f} MB")
        command = [sys.executable, "-m", "stream_dmr.cli.main", "replay", str(long)]
        command += ["--from", "localize", "--calibration", str(moved), "--timings"]
        for more in ([], ["--out", str(Path(scratch) / "out")]):
            used_s = cpu_s()
            done = subprocess.run([*command, *more], capture_output=True, text=True, check=True)
            used_s = cpu_s() - used_s
            said = done.stdout[done.stdout.index("stage  ") :]
            print("with a new recording:" if more else "lengths alone:", f"\n{said.rstrip()}")
            print(f"{60 * arguments.minutes / used_s:.0f} times real time, by CPU time")


def cpu_s() -> float:
    """CPU time of all commands so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def repeated(run: Recording, *, minutes: float) -> Iterator[Record]:
    """The records of a run, again and again."""
    found = list(decoded_messages(run, list(TOPICS)))
    times = sorted({message.timestamp_ns for message, _ in found if isinstance(message, Frame)})
    period_ns = times[-1] - times[0] + (times[-1] - times[0]) // (len(times) - 1)
    num_tracks = max(getattr(message, "track_id", 0) for message, _ in found)
    rounds = takewhile(lambda k: k * period_ns < minutes * 60e9, count())
    for k in rounds:
        for message, payload in found:
            shifted = shift(message, frames=k * len(times), ns=k * period_ns, ids=k * num_tracks)
            picture = stored_picture(payload) if isinstance(message, Frame) else None
            encoding = partial(encode, shifted, picture=picture)
            yield Record(message=shifted, whole=shifted, encoding=encoding)


def shift(message: Message, *, frames: int, ns: int, ids: int) -> Message:
    """The same message, later, of another fish."""
    changes: dict[str, object] = {
        "frame_index": message.frame_index + frames,
        "timestamp_ns": message.timestamp_ns + ns,
    }
    if not isinstance(message, Frame):
        changes["track_id"] = message.track_id + ids
    if isinstance(message, LengthEstimate):
        for name in ("first_frame", "last_frame"):
            changes[name] = getattr(message, name) + frames
        for name in ("first_timestamp_ns", "last_timestamp_ns"):
            changes[name] = getattr(message, name) + ns
    return replace(message, **changes)


if __name__ == "__main__":
    main()
