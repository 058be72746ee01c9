"""Makes the corpus with the code of one tree, through its command line alone."""

import json
import re
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from tests.corpus.scenes import drawn_box, frames_of
from tests.corpus.shell import Review, Shell

MADE = "made.json"  # when a corpus was made, and where
_CALIBRATED = ("--calibration", "scenes/rail/calibration.yaml")
_RAIL = ("--source", "scenes/rail/video.mp4", *_CALIBRATED)
_EXPORTS = (
    *(["--meshes", "ply"], ["--meshes", "glb"], ["--masks"], ["--viame"], ["--hauls"]),
    *(["--tables", "csv"], ["--tables", "parquet"], ["--fish", "csv"], ["--fish", "parquet"]),
    *(["--agency", "wcpfc"], ["--agency", "rdbes"]),
)


def make_corpus(tree: Path, scenes: Path, folder: Path, names: Sequence[str]) -> None:
    """Write the outputs of the runs `names` into a new folder."""
    shutil.copytree(scenes, folder / "scenes")
    shell = Shell(tree, folder)
    shell.require("setup")
    began_ns = time.time_ns()
    for name in names:
        began_s = time.monotonic()
        RUNS[name](shell)
        print(f"  {name}: {time.monotonic() - began_s:.0f} s", flush=True)
    shutil.rmtree(folder / "scenes")
    made = {"began_ns": began_ns, "ended_ns": time.time_ns()}
    made |= {"folder": str(folder), "tree": str(tree)}
    (folder / MADE).write_text(json.dumps(made))


def _auto(shell: Shell) -> None:
    """A video and nothing else: the fish are found, their shape is learnt."""
    shell.call("auto/run", "run", *_RAIL, "--out", "auto/out", "--log-json")
    shell.call("auto/run_again", "run", *_RAIL, "--out", "auto/out")
    shell.call("auto/uncalibrated", "run", *_RAIL[:2], "--out", "auto/uncalibrated")
    _check(shell, "auto", stages=("crop", "fit", "localize", "smooth"))
    shell.call("auto/replay_rrd", "replay", "auto/out/recording.rrd", "--check")
    other = ("--from", "localize", *_CALIBRATED, "--track", "1", "--time", "0.5:0.8")
    shell.call("auto/replay_part", "replay", "auto/out", *other, "--out", "auto/part")
    _tear(shell.folder / "auto" / "out", shell.folder / "auto" / "torn")
    shell.call("auto/recover", "recover", "auto/torn")
    lengths = ("--lengths", "auto/out/lengths.csv", "--truth", "scenes/rail/truth.csv")
    shell.call("auto/evaluate", "evaluate", *lengths)
    learnt = ("learn-template", "auto/out", "--out", "auto/learnt.ply")
    shell.call("auto/learn_template", *learnt)
    shell.call("auto/convert", "convert", "auto/out", "--out", "auto/converted.rrd")


def _other_mesh(shell: Shell) -> None:
    """A given mesh that is not the fish's."""
    mesh = ("--template", "scenes/eel/species.ply")
    shell.call("other_mesh/run", "run", *_RAIL, *mesh, "--out", "other_mesh/out")
    _check(shell, "other_mesh")


def _pauses(shell: Shell) -> None:
    """Given boxes and masks, whose ids pause for 8, 30 and 70 s."""
    config = ("--config", "scenes/pauses.toml", *_CALIBRATED)
    given = ("--source", "scenes/pauses/pictures", *config, "--template", "halibut")
    for kind, value in (("boxes", "boxes.txt"), ("masks", "masks")):
        out = f"pauses/{kind}"
        shell.call(f"{out}_run", "run", *given, f"--{kind}", f"scenes/pauses/{value}", "--out", out)
        _check(shell, "pauses", kind)


def _stills(shell: Shell) -> None:
    """Pictures that stand for themselves, with equal ids in several."""
    given = ("--source", "scenes/stills/pictures", "--masks", "scenes/stills/masks", "--stills")
    shell.call("stills/run", "run", *given, *_CALIBRATED, "--out", "stills/out")
    _check(shell, "stills")


def _clips(shell: Shell) -> None:
    """A folder of clips, measured, and measured on after a clip more has come."""
    clips = shell.folder / "clips" / "source"
    clips.mkdir(parents=True)
    calibration = ("--calibration", "scenes/trip/calibration.yaml")
    given = ("run", "--source", "clips/source", *calibration, "--config", "scenes/clips.toml")
    for number, names in enumerate((["1.mp4", "2.mp4"], ["3.mp4"], []), start=1):
        for name in names:
            shutil.copy2(shell.folder / "scenes" / "clips" / name, clips)
        shell.call(f"clips/run_{number}", *given, "--out", "clips/out")
    _check(shell, "clips")
    shutil.rmtree(clips)


def _trip(shell: Shell) -> None:
    """Species, zones, hauls, positions and a key; reviewed, and exported before and after."""
    scene = shell.folder / "scenes" / "trip"
    given = ("--source", "scenes/trip/video.mp4", "--masks", "scenes/trip/masks")
    given += ("--calibration", "scenes/trip/calibration.yaml", "--config", "scenes/trip.toml")
    given += ("--nmea", "scenes/trip/track.nmea", "--key", "scenes/device.key")
    given += ("--vessel", "Sea Bird", "--trip", "21-06")
    shell.call("trip/run", "run", *given, "--out", "trip/out")
    start = ("haul", "start", "trip/out", "--name", "by hand", "--at", "2021-06-01T07:00:01Z")
    shell.call("trip/haul_start", *start)
    shell.call("trip/haul_end", "haul", "end", "trip/out", "--at", "2021-06-01T07:00:02Z")
    _check(shell, "trip", key="scenes/device.key.pub")
    for asked in _EXPORTS:
        name = "_".join(asked).replace("--", "")
        shell.call(f"trip/export_{name}", "export", "trip/out", "--out", f"trip/{name}", *asked)
    shell.call("trip/verify_export", "verify", "trip/fish_csv")
    with shell.review("trip/out", "--reviewer", "Ada") as review:
        _review(review, scene, shell.folder / "trip")
    with shell.review("trip/out", "--reviewer", "Bo", "--blind") as review:
        said = [
            review.post(kind=kind, track_id=fish) for kind, fish in (("accept", 2), ("split", 1))
        ]
        (shell.folder / "trip" / "blind_verdicts.txt").write_text("".join(said))
    shell.call("trip/agreement", "agreement", "trip/out")
    edited = ("--fish", "csv", "--tables", "csv", "--viame", "--agency", "rdbes", "--hauls")
    shell.call("trip/export_edited", "export", "trip/out", "--out", "trip/edited", *edited)
    shell.call("trip/verify_edited", "verify", "trip/out", "--key", "scenes/device.key.pub")
    shell.call("trip/report_edited", "report", "trip/out", "--out", "trip/edited.html")
    shutil.copytree(shell.folder / "trip" / "out", shell.folder / "trip" / "tampered")
    with (shell.folder / "trip" / "tampered" / "lengths.csv").open("a") as file:
        file.write("\n")
    shell.call("trip/verify_tampered", "verify", "trip/tampered")


def _review(review: Review, scene: Path, folder: Path) -> None:
    """Decide on fish, add one, split, merge, undo; keep all answers."""
    seen = frames_of(scene)
    first, last = seen[1][2], seen[1][7]
    ns = {frame: round((frame - 1) * 1e9 / 15) for frame in (first, last)}
    boxes = [drawn_box(scene, 1, frame, ns[frame]) for frame in (first, last)]
    points = {"head": [20.0, 64.0], "tail": [108.0, 64.0]}
    shown = json.loads(review.get("fish.json?run=0&fish=4"))
    (folder / "page.html").write_bytes(review.get(""))
    answers = [
        json.dumps(shown) + "\n",
        review.post(kind="accept", track_id=1),
        review.post(kind="reject", track_id=2),  # refused: without a reason
        review.post(kind="reject", track_id=2, reason="no fish"),
        review.post(kind="species", track_id=3, species="COE"),
        review.post(kind="fate", track_id=3, fate="landed"),
        review.post(kind="condition", track_id=3, condition="A1"),
        *(review.post(kind="correct", track_id=4, frame_index=f, **points) for f in seen[4][3:9]),
        review.post(kind="split", track_id=1, frame_index=seen[1][5]),
        review.post(kind="merge", track_id=1, other_fish=5),
        review.post(kind="split", track_id=3, frame_index=seen[3][5]),
        review.post(kind="duplicate", track_id=6, duplicate_of=3),
        review.post(kind="reject", track_id=5, reason="no fish"),
        review.post(kind="add", boxes=boxes),  # over fish 5, which asks while that counts
        review.post(kind="withdraw", track_id=5),
        review.post(kind="accept", track_id=1),
        review.post(kind="undo"),
        review.get("reviewed.json").decode() + "\n",
    ]
    (folder / "verdicts.txt").write_text("".join(answers))
    (folder / "clip.bin").write_bytes(review.get("clip?run=0&fish=1"))


def _commands(shell: Shell) -> None:
    """Texts of help, wrong values, and commands that need no run."""
    listed = shell.call("commands/help", "--help")
    for name in re.findall(r"^  ([a-z][a-z-]*)  ", listed, re.MULTILINE):
        shell.call(f"commands/help_{name}", name, "--help")
    wrong = {
        "no_source": ("run", "--source", "missing.mp4"),
        "no_template": ("run", *_RAIL, "--template", "whale", "--out", "commands/none"),
        "no_config": ("run", *_RAIL, "--config", "missing.toml", "--out", "commands/none"),
        "no_option": ("run", "--sauce", "video.mp4"),
        "no_stage": ("replay", "missing", "--from", "swim"),
        "no_folder": ("verify", "missing"),
        "no_species": ("simulate", "--species", "whale", "--out", "commands/none"),
    }
    for name, words in wrong.items():
        shell.call(f"commands/wrong_{name}", *words)
    scene = ("--fish", "2", "--frames", "16", "--seed", "1", "--preset", "severe")
    shell.call("commands/simulate", "simulate", *scene, "--out", "commands/scene")
    mask = ("--side", "scenes/stills/masks/000002.png", "--out", "commands/one.ply")
    shell.call("commands/make_template", "make-template", *mask)
    manifest = shell.folder / "scenes" / "manifest.csv"
    video = ("rail/video.mp4", "rail/calibration.yaml", "rail/boxes.txt", "", "A", "1", "2")
    columns = "video,calibration,boxes,masks,vessel,trip,haul\n"
    manifest.write_text(columns + ",".join(video) + "\n")
    batch = ("batch", "scenes/manifest.csv", "--workers", "1", "--out", "commands/batch")
    shell.call("commands/batch", *batch)
    shell.call("commands/batch_again", *batch)
    shell.call("commands/verify_batch", "verify", "commands/batch")
    shell.call("commands/report_batch", "report", "commands/batch", "--out", "commands/batch.html")


def _check(
    shell: Shell, name: str, out: str = "out", *, stages: Sequence[str] = ("fit",), key: str = ""
) -> None:
    """Verify, replay and report a run."""
    folder = f"{name}/{out}"
    shell.call(f"{folder}_verify", "verify", folder, *(("--key", key) if key else ()))
    for stage in stages:
        shell.call(f"{folder}_replay_{stage}", "replay", folder, "--from", stage, "--check")
    shell.call(f"{folder}_report", "report", folder, "--out", f"{folder}.html")


def _tear(out: Path, torn: Path) -> None:
    """A copy of a run whose recording was not closed."""
    shutil.copytree(out, torn)
    whole = (torn / "recording.mcap").read_bytes()
    (torn / "recording.mcap").unlink()
    (torn / "recording.mcap.part").write_bytes(whole[:-8])


RUNS: dict[str, Callable[[Shell], None]] = {
    "auto": _auto,
    "other_mesh": _other_mesh,
    "pauses": _pauses,
    "stills": _stills,
    "clips": _clips,
    "trip": _trip,
    "commands": _commands,
}
