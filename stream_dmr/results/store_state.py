"""What a lengths.db holds beside fish, events and runs, for sums and signatures.

Marks, clips and scenes say where a run goes on and what it compares with; checks are of the scale.
"""

import json
import sqlite3
from collections.abc import Mapping, Sequence
from hashlib import sha256

from stream_dmr.results.sql import has_table

# The mark of the last id that a reviewer gave to a fish. Verdicts are summed up by themselves.
REVIEWED_ID = "reviewed_id"

# "written" counts the statements of a store, also those that sign: no sum can hold it.
_MARKS = (
    f"SELECT name, value FROM marks WHERE name NOT IN ('written', '{REVIEWED_ID}') ORDER BY name"
)
_CLIPS = "SELECT name, frames_done, is_done FROM clips ORDER BY name"
_SCENES = "SELECT calibration_sha256, data FROM scenes ORDER BY calibration_sha256"


def read_state(database: sqlite3.Connection) -> Mapping[str, object]:
    """Marks, clips and scenes, these by their hashes; a run changes them as it goes on."""
    return {
        "marks": [[*row] for row in database.execute(_MARKS)],
        "clips": [[*row] for row in database.execute(_CLIPS)],
        "scenes": [[key, sha256(data).hexdigest()] for key, data in database.execute(_SCENES)],
    }


def check_lines(database: sqlite3.Connection) -> Sequence[str]:
    """The checks of the scale in their order, each as a line of JSON; rows are only added."""
    if not has_table(database, "checks"):
        return []
    return [json.dumps(row) for row in database.execute("SELECT * FROM checks ORDER BY number")]
