"""A Ray cluster of two nodes in this machine measures a manifest, and loses a worker meanwhile.

`python ray_cluster.py MANIFEST CONFIG TEMPLATE OUT`. A process of its own: Ray leaves threads and
warnings behind, which tests count as failures.
"""

import os
import signal
import sys
import threading
import time
from contextlib import closing, suppress
from pathlib import Path

from ray.cluster_utils import Cluster

from stream_dmr.batch.driver import run_batch
from stream_dmr.batch.engines import RayEngine
from stream_dmr.batch.manifest import read_manifest
from stream_dmr.errors import UserError


def kill_one(out: Path, killed: list[int]) -> None:
    """Kill the first worker that measures."""
    until = time.monotonic() + 300
    while time.monotonic() < until and not killed:
        if any(out.rglob("*.part/recording.mcap.part")):
            for folder in Path("/proc").glob("[0-9]*"):
                name = (folder / "cmdline").read_bytes() if folder.exists() else b""
                if name.startswith(b"ray::measure") and not killed:
                    os.kill(int(folder.name), signal.SIGKILL)
                    killed.append(int(folder.name))
        time.sleep(0.01)


def main() -> None:
    """Print the number of nodes, of workers killed, and of videos done."""
    manifest, config, template, out = (Path(word) for word in sys.argv[1:])
    # Else its workers wait for all else on the machine.
    os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112
    jobs = read_manifest(manifest, config=config, template=str(template))
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "num_gpus": 0})
    cluster.add_node(num_cpus=1, num_gpus=0)
    killed: list[int] = []
    killer = threading.Thread(target=kill_one, args=(out, killed))
    try:
        with suppress(UserError):
            RayEngine(address=cluster.address, gpus=0.25)
            raise AssertionError("there is no GPU")
        with closing(RayEngine(address=cluster.address)) as engine:
            cluster.wait_for_nodes()
            killer.start()
            summary = run_batch(jobs, out, engine, stop=threading.Event(), log=print)
            killer.join()
    finally:
        cluster.shutdown()
    done = sum(one.status == "done" for one in summary.outcomes)
    print(f"nodes 2, killed {len(killed)}, done {done}")


if __name__ == "__main__":
    main()
