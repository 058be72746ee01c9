"""Which frame the pictures are that an annotation file names."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from stream_dmr.errors import AnnotationError


def frames_by_name(
    names: Mapping[int, str], pictures: Sequence[Path], *, where: Path
) -> dict[int, int]:
    """The frames of named pictures by their keys in `names`; none where no name is known.

    `pictures` of the source, in its order; empty of a video. A picture is known by its file name,
    else by that without its suffix. One that the source does not have gets a frame past its end.
    Raises AnnotationError, about `where`, where two names are one picture.
    """
    stems = Counter(path.stem for path in pictures)
    frames = {path.stem: i for i, path in enumerate(pictures, start=1) if stems[path.stem] == 1}
    frames |= {path.name: i for i, path in enumerate(pictures, start=1)}
    files = {key: Path(re.split(r"[\\/]", name)[-1]) for key, name in names.items()}
    found = {key: frames.get(file.name, frames.get(file.stem, 0)) for key, file in files.items()}
    if not any(found.values()):
        return {}
    keys = dict[int, int]()
    for key, frame in found.items():
        if frame and keys.setdefault(frame, key) != key:
            raise AnnotationError(
                f"{where}: expected each picture of the source once, got {names[keys[frame]]} and "
                f"{names[key]}; give the boxes of this folder alone"
            )
    past_end = iter(range(len(pictures) + 1, len(pictures) + len(found) + 1))
    return {key: frame or next(past_end) for key, frame in found.items()}
