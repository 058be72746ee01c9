"""The file of a digest: a zip whose comment is the signature over every byte before it."""

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

from stream_dmr.errors import OutputError, reason_of
from stream_dmr.files import read_small
from stream_dmr.store.ledger import SIGNATURE_BYTES, Signer, is_signature

CONTENT = "stream-dmr digest.json"  # the first name in the zip, which `is_made_by` looks for
ENTRY_BYTES = 30 + 46  # of the zip for a picture, beside its name, which the zip contains twice
_MAX_CONTENT_BYTES = 2_000_000  # some ten thousand fish; a small zip may hold gigabytes of zeros


def pack(content: Mapping[str, Any], pictures: Mapping[str, bytes], signer: Signer) -> bytes:
    """The bytes of the file, signed if there is a key; the same for the same content."""
    text, packed = json.dumps(content, separators=(",", ":"), ensure_ascii=False), io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, data in {CONTENT: text.encode(), **pictures}.items():
            kind = zipfile.ZIP_DEFLATED if name == CONTENT else zipfile.ZIP_STORED
            archive.writestr(zipfile.ZipInfo(name), data, kind, compresslevel=9)  # of 1980
        archive.comment = bytes(SIGNATURE_BYTES if signer.has_key else 0)
    data = packed.getvalue()
    signed = data[: len(data) - len(archive.comment)]
    return signed + signer.sign_bytes(signed)


def read_digest(path: Path, key: Ed25519PublicKey | None = None) -> dict[str, Any] | None:
    """The content of a digest; None if `key` did not sign every byte of it.

    Raises OutputError if it can't be read.
    """
    try:
        data = read_small(path)
        if key and not is_signature(key, data[-SIGNATURE_BYTES:], data[:-SIGNATURE_BYTES]):
            return None
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            said = archive.getinfo(CONTENT)
            # `archive.read` unpacks all there is, whatever size is said, and so do other methods.
            if said.compress_type not in (zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED):
                raise ValueError("another way of packing")
            with archive.open(said) as file:
                text = file.read(_MAX_CONTENT_BYTES + 1)
            if len(text) > _MAX_CONTENT_BYTES:
                raise ValueError("too much")
            content = json.loads(text)
            if not isinstance(content["day"], str) or not isinstance(content["fish"], list):
                raise ValueError("no day of fish")
            return content
    except Exception as error:  # of zipfile, zlib and JSON: damage has many
        raise OutputError(
            f"{path}: expected a digest, got: {reason_of(error)}; check the path, or make it again"
        ) from error
