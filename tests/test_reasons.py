"""Every reason is explained, given by some stage, and the only text that a stage refuses with."""

from pathlib import Path

import pytest

from stream_dmr.messages import FittedMesh, LengthEstimate, LocalizedFish
from stream_dmr.reasons import MEASURED, MEASURING, Reason, with_counts, without_counts
from stream_dmr.recording.codec import decode
from stream_dmr.recording.reading import open_recordings

ROOT = Path(__file__).parents[1]
SOURCES = [*(ROOT / "stream_dmr").rglob("*.py"), *(ROOT / "nodes").rglob("*.py")]


@pytest.mark.parametrize("reason", Reason)
def test_reason_is_its_text_and_explained(reason):
    assert reason == str(reason) == reason.value
    assert Reason(str(reason)) is reason
    assert reason.subject
    assert reason.explanation
    assert reason.remedy


@pytest.mark.parametrize("reason", Reason)
def test_some_stage_gives_reason(reason):
    texts = (path.read_text(encoding="utf-8") for path in SOURCES)
    assert any(f"Reason.{reason.name}" in text for text in texts)


@pytest.mark.parametrize("reason", Reason)
def test_no_stage_spells_reason_out(reason):
    spelled = [
        path
        for path in SOURCES
        if path.name != "reasons.py" and f'"{reason}"' in path.read_text(encoding="utf-8")
    ]
    assert not spelled


def test_counts_are_added_and_removed():
    text = with_counts(Reason.TOO_FEW_FRAMES, 2, 3)
    assert text == "too few good frames (2 of 3)"
    assert without_counts(text) == Reason.TOO_FEW_FRAMES
    assert without_counts(MEASURED) == MEASURED


def test_golden_recording_refuses_with_reasons_alone():
    recording = open_recordings([ROOT / "recordings" / "golden" / "recording.mcap"])
    found = set()
    for kind, data in recording.payloads([FittedMesh, LocalizedFish, LengthEstimate]):
        message = decode(kind, data)
        match message:
            case FittedMesh():
                found.add(message.refusal)
            case LocalizedFish():
                found.add(message.reason)
            case LengthEstimate():
                found |= {message.frame_reason, without_counts(message.status), *message.refused}
    assert found <= {"", MEASURED, MEASURING, *Reason}
    assert found & set(Reason)
