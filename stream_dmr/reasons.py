"""Every reason for which a frame doesn't count or a fish gets no length, explained.

The values stand in tables and recordings, so they stay as they are. `make docs` writes them as the
table of `docs/troubleshooting.md`.
"""

from enum import StrEnum

_FIT = "A frame that was not fitted"
_PLACE = "A frame that can't be localized"
_FRAME = "A frame that is refused"
_FISH = "A fish that has no length"

# Other values of a fish's status: it has a length, or its track has not ended yet.
MEASURED, MEASURING = "measured", "measuring"


class Reason(StrEnum):
    """A reason for a refusal; equal to its text."""

    subject: str  # the refused thing, as the start of a sentence
    explanation: str
    remedy: str  # advice for users

    def __new__(cls, text: str, subject: str, explanation: str, remedy: str) -> "Reason":
        reason = str.__new__(cls, text)
        reason._value_ = text
        reason.subject, reason.explanation, reason.remedy = subject, explanation, remedy
        return reason

    NO_MASK = (
        "no mask",
        _FIT,
        "nothing was segmented in the box",
        "a better box, or train the network",
    )
    MASK_FILLS_CROP = (
        "mask fills the crop",
        _FIT,
        "the mask has no edge in the crop",
        "the masks are wrong, or `[crop_fish] margin` too small",
    )
    MASK_TOO_SMALL = (
        "mask too small",
        _FIT,
        "fewer pixels than `[fit_mesh] min_mask_px`",
        "the fish is too far away",
    )
    FIT_DIVERGED = (
        "fit diverged",
        _FIT,
        "the fit ended in numbers that are not finite",
        "look at the mask",
    )
    NO_CALIBRATION = (
        "no calibration",
        _PLACE,
        "there is no calibration, so no millimetres",
        "calibrate",
    )
    PLANE_BEHIND_CAMERA = (
        "plane behind camera",
        _PLACE,
        "the ray through the fish's center does not meet the reference plane",
        "the calibration's plane is wrong",
    )
    KEYPOINTS_COINCIDE = (
        "keypoints coincide",
        _PLACE,
        "head, center and tail of the fit lie in one place, or nearer together than fish "
        "are broad: the mask's area is above the square of their distance",
        "look at the mask",
    )
    SEEN_END_ON = (
        "seen end-on",
        _PLACE,
        "head or tail points straight at the camera, or away from it",
        "nothing; other frames count",
    )
    KEYPOINTS_DISAGREE = (
        "keypoints disagree",
        _PLACE,
        "the rays and the fitted shape contradict each other",
        "look at the fit and the calibration",
    )
    TOUCHES_BORDER = (
        "touches border",
        _FRAME,
        "the fish reaches the edge of the picture, or of every crop",
        "nothing; or `[localize] refuse_border`",
    )
    MOSTLY_HIDDEN = (
        "mostly hidden",
        _FRAME,
        "less is visible than `[localize] min_visible_fraction`",
        "nothing; other frames count",
    )
    UNSURE_MASK = (
        "unsure mask",
        _FRAME,
        "the mask's confidence is below `[localize] min_mask_confidence`",
        "train the network",
    )
    END_NOT_SEEN = (
        "end not seen",
        _FRAME,
        "the mask seems to lack snout or tail: `[localize] max_missing_end`",
        "look at the mask: dark ends want light, and fish no other fish upon them; or draw the box "
        "around all of the fish",
    )
    POOR_FIT = (
        "poor fit",
        _FRAME,
        "the mesh overlaps the mask by less than `[localize] min_iou`, of slender fish less",
        "look at mask and template",
    )
    UNCERTAIN = (
        "uncertain",
        _FRAME,
        "the fit's length is less certain than `[localize] max_length_std_ratio`",
        "nothing; other frames count",
    )
    TURNED_AWAY = (
        "turned away",
        _FRAME,
        "the fish slants by more than `[localize] max_slant_rad`",
        "nothing; other frames count",
    )
    BENT_TOO_FAR = (
        "bent too far",
        _FRAME,
        "the fit's midline bows out of its own plane of view, or curls, further than a fish can: "
        "`[localize] max_bow_ratio`, `max_bending_ratio`",
        "look at mask and template; usually a wrong mask",
    )
    SEEN_BY_ONE = (
        "seen by one camera",
        _FRAME,
        "`combine`: the other camera saw the fish, but not at this moment",
        "nothing; other frames count",
    )
    CAMERAS_DISAGREE = (
        "cameras disagree",
        _FRAME,
        "`combine`: no fish is where both cameras see this one",
        "look at the masks of both; was a camera moved?",
    )
    OUTLIER = ("outlier", _FRAME, "the length contradicts the other frames of this fish", "nothing")
    LONG_ENOUGH = (
        "measured long enough",
        _FRAME,
        "the fish has `[smooth_length] max_frames` good frames",
        "nothing",
    )
    TRACK_ENDED = (
        "track has ended",
        _FRAME,
        "the id was seen again after `[smooth_length] track_timeout_s`",
        "a longer timeout, or better ids",
    )
    TOO_FEW_FRAMES = (
        "too few good frames",
        _FISH,
        "fewer than `[smooth_length] min_frames` frames count; both numbers follow in brackets",
        "the reasons of its frames; `min_frames`",
    )
    TOO_UNCERTAIN = (
        "too uncertain",
        _FISH,
        "its frames contradict each other, or none of them is certain: the std is above "
        "`[smooth_length] max_std_ratio`; or it gets ever longer or shorter, or as many frames are "
        "`turned away` as count",
        "look at its frames",
    )
    LONGER_THAN_SPECIES = (
        "longer than the species grows",
        _FISH,
        "the classifier is sure of the species, and the whole 95 % interval is above its largest "
        "known length, see [Species](species.md#the-list)",
        "look at the species, the scale and the masks",
    )


def with_counts(reason: Reason, count: int, expected: int) -> str:
    """A reason with the numbers that it is due to: "too few good frames (2 of 3)"."""
    return f"{reason} ({count} of {expected})"


def without_counts(status: str) -> str:
    """A fish's status without the numbers that `with_counts` adds, to count fish by it."""
    return status.split(" (")[0]
