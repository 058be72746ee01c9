"""`stream-dmr setup`: what is done once after an installation."""

import time


def setup() -> None:
    """Compile the numeric loops, so that the first run need not; a run does it by itself else."""
    from rich.console import Console

    from stream_dmr.cli.shared_options import stop_on_signals
    from stream_dmr.running.prepare_kernels import prepare_kernels

    began, console = time.monotonic(), Console(stderr=True, highlight=False)
    with stop_on_signals() as stop, console.status("") as status:
        said = list[str]()

        def say(line: str) -> None:
            """Draw it on a terminal; elsewhere print the first line alone."""
            if not console.is_terminal and not said:
                console.print(line, markup=False)
            said.append(line)
            status.update(line)

        prepare_kernels(say, stop=stop)
    stop.exit()
    print(f"ready, after {time.monotonic() - began:.0f} s")
