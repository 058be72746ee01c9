"""Which errors end a run: at sea, one bad frame must not cost all that follow."""

from collections.abc import Callable

from stream_dmr.errors import OutputError, UserError

_MAX_CONSECUTIVE = 100  # failed frames (some 10 s): then it is the run that is broken. Chosen.


class ErrorPolicy:
    """Decides whether a chain continues after an exception, which then costs one frame.

    A run with an end never does. An endless one does, except after a wrong input, which stays
    wrong; a full disk (OutputError) may be emptied.
    """

    def __init__(self, *, is_endless: bool, on_notice: Callable[[str], None]) -> None:
        self._is_endless = is_endless
        self._on_notice = on_notice
        self._num_consecutive = 0

    def frame_done(self) -> None:
        """A frame went through the whole chain, so the chain works."""
        self._num_consecutive = 0

    def continues_after(self, stage: str, error: Exception) -> bool:
        """True where the chain goes on after this exception in this stage."""
        if not self._is_endless or self._num_consecutive >= _MAX_CONSECUTIVE:
            return False
        if isinstance(error, UserError) and not isinstance(error, OutputError):
            return False
        self._num_consecutive += 1
        self._on_notice(f"a frame failed in {stage}: {type(error).__name__}: {error}")
        return True
