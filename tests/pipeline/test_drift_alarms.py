"""Alarms of an endless run in its store: noted when they change, flags of the fish meanwhile."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from stream_dmr.messages import Frame
from stream_dmr.pipeline.config import DriftSettings
from stream_dmr.pipeline.drift import DriftAlarms
from stream_dmr.store.length_store import LengthStore
from tests.support.final_estimates import FACTS, fish

SETTINGS = DriftSettings(reference_fish=20, recent_fish=10)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[LengthStore]:
    with closing(LengthStore(tmp_path, FACTS)) as store:
        yield store


def ignore(_: object) -> None:
    pass


def flags_of(alarms: DriftAlarms, ious: np.ndarray) -> list[list[str]]:
    return [alarms.take_fish(float(iou), timestamp_ns=k) for k, iou in enumerate(ious)]


def test_worse_fish_are_flagged_and_the_change_is_noted_once(store: LengthStore):
    rng, notices, causes = np.random.default_rng(1), list[str](), list[Sequence[str]]()
    alarms = DriftAlarms(store, SETTINGS, on_alarm=causes.append, on_notice=notices.append)
    assert not any(flags_of(alarms, rng.normal(0.93, 0.01, 20)))
    flags = flags_of(alarms, rng.normal(0.85, 0.01, 30))
    assert flags[-1] == flags[-2] != []
    assert len(notices) == 1
    assert flags_of(alarms, rng.normal(0.93, 0.01, 30))[-1] == []
    assert len(notices) == 2
    assert causes == [tuple(flags[-1]), ()]


def test_what_another_thread_finds_meanwhile_is_told_afterwards(store: LengthStore):
    rng, causes, others = np.random.default_rng(1), list[Sequence[str]](), list[Thread]()

    def tell(told: Sequence[str]) -> None:
        if not others:  # the alarm ends in the other thread while its begin is told
            others.append(Thread(target=flags_of, args=(alarms, rng.normal(0.93, 0.01, 30))))
            others[0].start()
            others[0].join(0.5)
        causes.append(told)

    alarms = DriftAlarms(store, SETTINGS, on_alarm=tell, on_notice=ignore)
    flags_of(alarms, rng.normal(0.93, 0.01, 20))
    worse = iter(rng.normal(0.85, 0.01, 30))
    while not causes:
        alarms.take_fish(float(next(worse)), timestamp_ns=1)
    others[0].join()
    assert causes[-1] == ()


def test_a_fish_without_an_iou_changes_nothing(store: LengthStore):
    alarms = DriftAlarms(store, SETTINGS, on_alarm=ignore, on_notice=ignore)
    assert alarms.take_fish(None, timestamp_ns=1) == []


def test_the_fish_of_earlier_runs_are_the_reference(store: LengthStore):
    for track_id in range(1, 21):
        store.add(fish(track_id), iou=0.93 + 0.001 * (track_id % 3))
    alarms = DriftAlarms(store, SETTINGS, on_alarm=ignore, on_notice=ignore)
    assert flags_of(alarms, np.full(10, 0.85))[-1] != []


def test_the_fish_of_another_template_are_no_reference(store: LengthStore, tmp_path: Path):
    for track_id in range(1, 21):
        store.add(fish(track_id), iou=0.93 + 0.001 * (track_id % 3))
    store.close()
    with closing(LengthStore(tmp_path, replace(FACTS, template_sha256="another"))) as later:
        alarms = DriftAlarms(later, SETTINGS, on_alarm=ignore, on_notice=ignore)
        assert not any(flags_of(alarms, np.full(40, 0.85)))


def test_the_first_static_scene_of_a_calibration_is_kept(store: LengthStore):
    picture = np.random.default_rng(2).integers(0, 255, (60, 80, 3)).astype(np.uint8)
    alarms = DriftAlarms(store, DriftSettings(sample_s=1.0), on_alarm=ignore, on_notice=ignore)
    assert store.scene() is None
    for k in range(40):
        frame = Frame(frame_index=k + 1, timestamp_ns=k * 10**9, image=picture, source="camera")
        alarms.take_frame(frame)
    kept = store.scene()
    assert kept is not None
    DriftAlarms(store, SETTINGS, on_alarm=ignore, on_notice=ignore).take_frame(frame)
    assert store.scene() == kept
