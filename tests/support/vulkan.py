"""Whether the viewer can draw here without a screen."""

from pathlib import Path

import pytest

DRIVERS = [*Path("/usr/share/vulkan/icd.d").glob("*"), *Path("/etc/vulkan/icd.d").glob("*")]
needs_vulkan = pytest.mark.skipif(
    not DRIVERS, reason="needs a Vulkan driver; a software one does: mesa-vulkan-drivers"
)
