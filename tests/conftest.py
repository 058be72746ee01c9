"""Shape annotations execute under pytest; scenes outside the repository skip with a reason."""

from pathlib import Path

import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

install_import_hook("stream_dmr", "beartype.beartype")

# Nothing is timed in tests: the first example pays for imports and compilers. By default the same
# examples come each time, so that a change is judged by itself; `make test-slow` draws new ones.
settings.register_profile("same", deadline=None, derandomize=True, max_examples=25)
settings.register_profile("new", deadline=None)
settings.load_profile("same")


SHARED = Path(__file__).resolve().parents[2] / "shared"


def _folder(name: str) -> Path:
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"needs the material in {folder}, which is not part of the repository")
    return folder


@pytest.fixture
def scenes() -> Path:
    """Scenes with known lengths, made by another generator than ours."""
    return _folder("scenes")


@pytest.fixture
def real() -> Path:
    """Real photographs and clips."""
    return _folder("real")
