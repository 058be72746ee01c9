"""Opens Rerun's streams, and ends them: left to themselves, they keep threads and memory."""

from typing import Any

import rerun as rr
from rerun_bindings import flush_and_cleanup_orphaned_recordings

from stream_dmr.recording.messages.run_header import RunHeader
from stream_dmr.recording.rerun.blueprint import blueprint


def new_stream(sink: Any, header: RunHeader) -> rr.RecordingStream:
    """A stream into one sink, with the layout of the view, without timelines of logging time."""
    rec = rr.RecordingStream("stream-dmr")
    rec.set_log_time_enabled(False)
    rec.set_log_tick_enabled(False)
    layout = blueprint(header)
    rec.set_sinks(sink, default_blueprint=layout)
    layout.end()
    return rec


def end_streams() -> None:
    """End the threads of streams that are disconnected and that nobody holds any more.

    Rerun does so at the next `rr.init` only, which a process that measures video after video, or
    a camera's segments, never calls.
    """
    flush_and_cleanup_orphaned_recordings()
