"""A simulated trip: three hauls hours apart, two species, fish that come aboard or fall off."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, sin
from pathlib import Path

import av
import numpy as np

from stream_dmr.camera import Calibration, Camera
from stream_dmr.simulation.rail_scene import RailScene, Visit, make_scene
from stream_dmr.simulation.simulated_fish import find_species
from stream_dmr.simulation.write_scene import write_scene
from stream_dmr.sources.sensors_settings import utc_ns_of
from tests.support.nmea import rmc

START_UTC = "2026-11-22T06:00:00Z"
CODES = {"halibut": "HAL", "conger": "COE"}
NAMES = ",".join(CODES)
VISIT_FRAMES, PAUSE_FRAMES = 16, 8
_SECOND_AFTER = 3  # frames after the first fish of a haul
HAUL_FRAMES = VISIT_FRAMES + _SECOND_AFTER + PAUSE_FRAMES
HAUL_S = 3600.0  # from one haul to the next
SENTENCES_S = 10.0
# By haul what becomes of its fish; species take turns.
FATES = (("landed", "dropped"), ("landed", "landed"), ("dropped", "landed"))


@dataclass(frozen=True, kw_only=True)
class TrueFish:
    """What a table must say of a fish."""

    track_id: int
    haul: str
    species_code: str
    fate: str
    length_mm: float
    utc_ns: int  # at the middle of its frames, as filmed
    place: tuple[float, float]  # latitude and longitude then


@dataclass(frozen=True, kw_only=True)
class Trip:
    """A folder with `video.mp4`, masks, calibration and positions, and the truth."""

    folder: Path
    fish: list[TrueFish]


def place_at(seconds: float) -> tuple[float, float]:
    """Latitude and longitude of the vessel, `seconds` after the start: a bow of some 20 km."""
    turn = seconds / 3000.0
    return 57.40 + 0.06 * sin(turn), -150.90 + 0.11 * (1 - cos(turn)) + 0.02 * turn


def make_trip(folder: Path, *, seed: int = 5) -> Trip:
    """Film a trip into a folder."""
    scene = _in_three_hauls(small_scene(num_fish=6, num_frames=6 * VISIT_FRAMES, seed=seed))
    write_scene(folder, scene, species=NAMES)
    delays_s = [HAUL_S * min(2, k // HAUL_FRAMES) for k in range(scene.num_frames)]
    times_ns = delay_frames(folder / "video.mp4", delays_s)
    _write_positions(folder / "track.nmea", times_ns[-1] / 1e9)
    seen: dict[int, list[int]] = {}
    for row in _rows(folder / "boxes.txt"):
        seen.setdefault(int(row[1]), []).append(int(row[0]))
    start_ns = utc_ns_of(START_UTC)
    fish = list[TrueFish]()
    for index, visit in enumerate(scene.visits):
        frames = seen[visit.fish.track_id]
        middle_ns = (times_ns[frames[0] - 1] + times_ns[frames[-1] - 1]) // 2
        fish.append(
            TrueFish(
                track_id=visit.fish.track_id,
                haul=str(index // 2 + 1),
                species_code=CODES[NAMES.split(",")[index % 2]],
                fate=FATES[index // 2][index % 2],
                length_mm=visit.fish.length_mm,
                utc_ns=start_ns + middle_ns,
                place=place_at(middle_ns / 1e9),
            )
        )
    return Trip(folder=folder, fish=fish)


def small_scene(*, num_fish: int, num_frames: int, seed: int) -> RailScene:
    """A clean scene of both species in a quarter of the pixels, which is drawn in less time."""
    scene = make_scene(
        num_fish=num_fish,
        num_frames=num_frames,
        preset="clean",
        seed=seed,
        species=find_species(NAMES),
    )
    camera = scene.calibration.camera
    K = camera.K * 0.5
    K[2, 2] = 1.0
    small = Camera(
        width=camera.width // 2, height=camera.height // 2, K=K, distortion=camera.distortion
    )
    return replace(scene, calibration=Calibration(camera=small, plane=scene.calibration.plane))


def _in_three_hauls(scene: RailScene) -> RailScene:
    """Two fish a haul, side by side; one that is dropped goes down again, half turned about."""
    visits = list[Visit]()
    for index, visit in enumerate(scene.visits):
        haul, place = divmod(index, 2)
        at = np.linspace(0, len(visit.poses) - 1, VISIT_FRAMES).round().astype(int)
        way = [visit.poses[k] for k in at]
        if FATES[haul][place] == "dropped":
            half = way[: VISIT_FRAMES // 2]
            way = [*half, *half[::-1]]
        first = 1 + PAUSE_FRAMES // 2 + haul * HAUL_FRAMES + _SECOND_AFTER * place
        lane = np.array([-700.0 if place == 0 else 700.0, 0.0, 0.0])
        poses = [replace(p, center_world_mm=p.center_world_mm * [0.2, 1, 1] + lane) for p in way]
        visits.append(replace(visit, first_frame=first, poses=poses))
    num_frames = visits[-1].first_frame + VISIT_FRAMES + PAUSE_FRAMES
    return replace(scene, num_frames=num_frames, visits=visits)


def delay_frames(video: Path, delays_s: Sequence[float]) -> list[int]:
    """Let each frame of an MP4 come so much later; the times of all frames, ns."""
    delayed, times_ns = video.with_name("delayed.mp4"), list[int]()
    with av.open(video) as old, av.open(delayed, "w") as new:
        stream = new.add_stream_from_template(old.streams.video[0])
        packets = (packet for packet in old.demux(video=0) if packet.pts is not None)
        for packet, delay_s in zip(packets, delays_s, strict=True):
            assert packet.pts is not None
            assert packet.time_base is not None
            packet.pts += round(delay_s / packet.time_base)
            packet.dts = packet.pts
            times_ns.append(round(packet.pts * packet.time_base * 1_000_000_000))
            packet.stream = stream
            new.mux(packet)
    delayed.replace(video)
    return times_ns


def _write_positions(path: Path, seconds: float) -> None:
    start_ns, every_ns = utc_ns_of(START_UTC), round(SENTENCES_S * 1e9)
    count = int(seconds / SENTENCES_S) + 3
    times = [start_ns + (i - 1) * every_ns for i in range(count + 1)]
    lines = [rmc(t, *place_at((t - start_ns) / 1e9), knots=5.0) for t in times]
    path.write_text("".join(lines), newline="")


def _rows(path: Path) -> list[list[str]]:
    with path.open(newline="") as file:
        return list(csv.reader(file))
