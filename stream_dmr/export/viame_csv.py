"""Write tracks as VIAME CSV, for DIVE: boxes, outlines, head and tail, length, species.

The columns are those of VIAME's `write_object_track_set_viame_csv` and of DIVE's reader: track,
time or picture, frame from 0, box, confidence, length or -1, species and its confidence, and then
`(kp) head x y`, `(kp) tail x y`, `(atr) NAME VALUE` of the box, `(trk-atr) NAME VALUE` of the
track, and of each part of the mask `(poly) x y x y ...`, with a `(hole) x y ...` for each hole.
Pixels are counted from the picture's corner.
"""

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import datetime, timedelta
from io import StringIO

from stream_dmr.export.coco_masks import mask_in_frame
from stream_dmr.export.fish_table import fish_record
from stream_dmr.messages import FishCrop, LocalizedFish
from stream_dmr.segmentation.mask_outlines import outlines_of
from stream_dmr.store.fish import Fish
from stream_dmr.store.fisheries import FisheriesSettings
from stream_dmr.tables import cell
from stream_dmr.template.template import Template

_HEADER = (
    "# 1: Detection or Track-id,2: Video or Image Identifier,3: Unique Frame Identifier,"
    "4-7: Img-bbox(TL_x,TL_y,BR_x,BR_y),8: Detection or Length Confidence,"
    "9: Target Length (0 or -1 if invalid),10-11+: Repeated Species,Confidence Pairs or Attributes"
)
NO_LENGTH, NO_SPECIES = -1, "fish"
PART = "(trk-atr) exported part"  # DIVE keeps it, unlike the content of the metadata line
_OF_TRACK = (  # columns of fish.csv
    *("length_mm", "ci95_low_mm", "ci95_high_mm", "length_type", "length_from", "frames_used"),
    *("status", "flags", "species", "species_code", "species_share", "fate", "fate_share"),
    *("verdict", "verdict_reason", "condition"),
)
_OF_BOX = ("length_mm", "length_std_mm", "reason")  # of LocalizedFish


def viame_csv(
    seen: Iterable[tuple[FishCrop, LocalizedFish]],
    fish: Mapping[int, Fish],
    template_of: Callable[[Fish], Template],
    *,
    fps: float | None,
    pictures: Mapping[int, str],
    is_part: bool = False,
) -> tuple[str, int]:
    """The file and the number of its boxes; `fish` by track id, `fps` None if unknown.

    `pictures`: names by frame index, of a folder of pictures. The facts of a track are in its first
    row; with `is_part` also that other fish or frames of the run are left out.
    """
    rows, text, told = list[list[object]](), StringIO(), set[int]()
    for crop, located in seen:
        known = fish.get(located.track_id)
        row = _row(crop, located, known, pictures.get(located.frame_index))
        if located.track_id not in told:
            told.add(located.track_id)
            record = {}
            if known is not None:
                record = fish_record(known, template_of(known), FisheriesSettings())
            row += _attributes("trk-atr", {name: record.get(name) for name in _OF_TRACK})
            row += [PART] if is_part else []
        rows.append(row)
    # DIVE's server takes "Fps: " in the second cell alone, its desktop program either; a line
    # without a second cell breaks the server.
    rate = "" if fps is None else f"# metadata,Fps: {fps:g},fps: {fps:g}\n"
    text.write(f"{_HEADER}\n{rate}")
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue(), len(rows)


def species_name(fish: Fish | None) -> str:
    """The species by a reviewer, else by a sure classifier, else NO_SPECIES."""
    return (fish.review.species or fish.sure_code if fish else "") or NO_SPECIES


def _row(
    crop: FishCrop, located: LocalizedFish, fish: Fish | None, picture: str | None
) -> list[object]:
    since = timedelta(microseconds=max(0, located.timestamp_ns) // 1000)
    time = (datetime(1970, 1, 1) + since).time().isoformat("microseconds")  # of a day
    length_mm = None if fish is None else fish.length_mm
    is_by_classifier = fish is not None and fish.sure_code and not fish.review.species
    share = fish.estimate.species_share if fish and is_by_classifier else None
    px = located.keypoints_px
    ends = {} if px is None else {"head": px[0] + 0.5, "tail": px[2] + 0.5}
    return [
        *(located.track_id, picture or time, located.frame_index - 1),
        *crop.bbox_xyxy_px.tolist(),
        *("1.0", NO_LENGTH if length_mm is None else f"{length_mm:.1f}"),
        *(species_name(fish), f"{share or 1.0:.3f}"),
        *(f"(kp) {name} {x:.1f} {y:.1f}" for name, (x, y) in ends.items()),
        *_polygons(crop),
        *_attributes("atr", {name: getattr(located, name) for name in _OF_BOX}),
    ]


def _attributes(kind: str, values: Mapping[str, object]) -> Iterator[str]:
    for name, value in values.items():
        if value not in (None, "", "[]"):
            yield f"({kind}) {name} {cell(value)}"


def _polygons(crop: FishCrop) -> Iterator[str]:
    for part in outlines_of(mask_in_frame(crop)):
        for name, ring in zip(("poly", *["hole"] * len(part)), part, strict=False):
            yield f"({name}) " + " ".join(f"{x:g} {y:g}" for x, y in ring.tolist())
