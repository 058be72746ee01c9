"""All methods by name, made when first needed, and the work of one process: one scene."""

from collections.abc import Callable
from functools import cache as cached
from pathlib import Path

from benchmarks.fit_speed.targets import species_template
from benchmarks.table1 import cached_results, stereo
from benchmarks.table1.bfs import BruteForce
from benchmarks.table1.dmr import ByTwo, Dmr, Paper
from benchmarks.table1.filmed_scene import FilmedScene, film_passages, table_scene
from benchmarks.table1.monopose import MonoPose
from benchmarks.table1.plate import Plate
from benchmarks.table1.silhouettes import open_database
from stream_dmr.evaluation.length_tables import LengthRow

METHODS = ("stereo", "monopose", "bfs", "dmr", "two", "paper")
LOG2_DATABASE = 20  # a million entries

Measure = Callable[[FilmedScene], dict[str, dict[int, LengthRow]]]


def measure_scene(task: tuple[int, list[str], Path]) -> int:
    """Film one scene, measure it by these methods, keep what they say; the scene's number."""
    scene, methods, cache = task
    filmed = film_passages(table_scene(scene), with_second=bool({"stereo", "two"} & {*methods}))
    for method in methods:
        measured = make_method(method, cache)(filmed)
        cached_results.save(method, scene, filmed.truth_mm, measured, cache=cache)
    return scene


@cached
def make_method(method: str, cache: Path, log2_database: int = LOG2_DATABASE) -> Measure:
    """What a method does with a filmed; all of them get the species' mean shape."""
    template = species_template()
    match method:
        case "stereo":
            return stereo.measure
        case "monopose":
            return MonoPose(Plate.from_template(template)).measure
        case "bfs":
            database = open_database(template, log2_size=log2_database, cache=cache)
            return BruteForce(template, database).measure
        case "dmr":
            return Dmr(template).measure
        case "two":
            return ByTwo(template).measure
        case "paper":
            return Paper(template).measure
    raise ValueError(f"expected one of {', '.join(METHODS)}, got {method}")
