"""Everyone beside the chain takes the messages that the next stage gets."""

import threading
from pathlib import Path

from stream_dmr.messages import FishCrop, Message
from stream_dmr.pipeline.chain import Chain
from stream_dmr.pipeline.measure_source import MessageFlow
from stream_dmr.pipeline.run_inputs import checked_inputs
from stream_dmr.pipeline.run_observer import RunObserver
from stream_dmr.pipeline.run_outputs import open_outputs
from stream_dmr.pipeline.session import Session
from tests.support.fish_run import FISH, request
from tests.support.tiny_clip import write_clip


class Keeping(RunObserver):
    def __init__(self) -> None:
        self.messages, self.num_frames = list[Message](), 0

    def take(self, message: Message) -> None:
        self.messages.append(message)

    def frame_done(self) -> None:
        self.num_frames += 1


def test_everyone_takes_what_the_next_stage_gets(tmp_path: Path):
    """A crop without its picture, as the recording has it: a replay reads the same."""
    write_clip(tmp_path / "clip", fish=FISH)
    inputs = checked_inputs(request(tmp_path / "clip", tmp_path / "out"))
    observer, passed_on = Keeping(), list[Message]()
    session = Session(inputs, given=[inputs.crop_fish(inputs.finder)])
    with open_outputs(inputs, observer) as outputs:
        flow = MessageFlow(inputs, session, outputs, observer, threading.Event())

        def on_message(message: Message) -> Message:
            passed_on.append(taken := flow.take(message))
            return taken

        Chain(
            inputs.reader,
            session.nodes,
            on_message=on_message,
            on_frame=flow.frame_done,
            stop=threading.Event(),
        ).run(in_one_thread=True)
        flow.finish()
        kept = outputs.store.estimates()
    inputs.reader.close()
    assert all(one is other for one, other in zip(observer.messages, passed_on, strict=True))
    assert all(crop.image is None for crop in passed_on if isinstance(crop, FishCrop))
    assert observer.num_frames == flow.totals.num_frames == len(FISH)
    assert [fish.track_id for fish in flow.totals.fish()] == [one.track_id for one in kept]
