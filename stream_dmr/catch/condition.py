"""What a reviewer says of a fish beside its length: condition and fate, by codes.

The condition codes are those of the regional observers of SPC and FFA, which WCPFC takes for
discards; the fields of longline forms are compared in WCPFC-SC9-2013/EB-WP-04, Appendix 1. They
were compared with the codes in public code that reads SPC's observer data, not with the paper.
"""

from stream_dmr.catch.fate import UNKNOWN_FATE
from stream_dmr.catch.zones import FATE_OF_ZONE

CONDITIONS: dict[str, str] = {
    "A0": "alive, not described further",
    "A1": "alive and healthy",
    "A2": "alive, injured or distressed",
    "A3": "alive, unlikely to live",
    "D": "dead",
    "U": "unknown",
}
FATES = (*FATE_OF_ZONE.values(), UNKNOWN_FATE)
