"""The checksum of this machine's arithmetic."""

import subprocess
import sys

from stream_dmr.recording.header import arithmetic_checksum


def test_it_is_a_crc_in_hexadecimal_digits():
    assert len(arithmetic_checksum()) == 8
    assert int(arithmetic_checksum(), 16) >= 0


def test_another_process_on_this_machine_has_the_same():
    script = "from stream_dmr.recording.header import arithmetic_checksum as c; print(c())"
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert answer.stdout.strip() == arithmetic_checksum()
