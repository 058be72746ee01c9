"""Which outputs of a run work and which fail, since when, and why: for /health and alerts."""

import threading
import time
from dataclasses import dataclass, replace


@dataclass(frozen=True, kw_only=True)
class SinkState:
    """One output, such as `frames.csv`."""

    name: str
    is_failing: bool
    since_ns: int  # wall clock, ns since 1970: it works, or fails, since then
    last_error: str = ""  # also after it works again

    @property
    def problem(self) -> str:
        """Why it fails, for people; "" while it works."""
        return f"{self.name} can't be written: {self.last_error}" if self.is_failing else ""


class SinkStates:
    """The state of each output, as those who write it report it. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._states: dict[str, SinkState] = {}

    def report(self, name: str, error: str = "") -> None:
        """An output was written to, or was refused with `error`."""
        with self._lock:
            state, is_failing = self._states.get(name), bool(error)
            if state is None or state.is_failing != is_failing:
                last_error = "" if state is None else state.last_error
                state = SinkState(
                    name=name,
                    is_failing=is_failing,
                    since_ns=time.time_ns(),
                    last_error=last_error,
                )
            self._states[name] = replace(state, last_error=error) if error else state

    def all(self) -> list[SinkState]:
        """The states of all outputs, in the order in which they were first written to."""
        with self._lock:
            return list(self._states.values())

    def problems(self) -> list[str]:
        """A line for each output that fails."""
        return [state.problem for state in self.all() if state.is_failing]
