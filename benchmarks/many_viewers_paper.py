"""A hundred replicas on paper: python benchmarks/many_viewers_paper.py [--write].

What one time of a rig takes in the object store, and to make; what a fetch and a question to the ingest cost; what a
message costs Serve's proxy and a replica: each measured here, by the processor time of the processes themselves, so
that other work on the machine does not count. From these follows where a cluster of a given size ends. Needs the
extra 'ray'.
"""

import argparse
import asyncio
import json
import os
import statistics
import time
from pathlib import Path

from measure import write

from viewmend.cluster import LOCAL, connect, find_ray
from viewmend.geometry.hull import HullConfig
from viewmend.live.clock import Span
from viewmend.live.frames import FrameSupply, Rig, SourceStatus
from viewmend.live.ingest import Ingest
from viewmend.live.shared_time import SharedTime
from viewmend.methods import make_method
from viewmend.observation import observe
from viewmend.studio.stage import Studio, StudioConfig

SIZES = ((320, 320), (512, 612))
CAMERAS, FPS = 8, 15.0
REPLICAS, MACHINES, VIEWERS = 100, 13, 8
"""The cluster: eight replicas a machine, and viewers at each."""
PICTURE_BYTES = 20_000
"""A moving view of 320 x 320 as JPEG, with its depth."""
CALLS, MESSAGES, CLIENTS = 2000, 1500, 4


def shared_times() -> dict[str, object]:
    """Bytes of a time and milliseconds to make it, by size and model; the median of some frames after the first."""
    found = {}
    for size in SIZES:
        studio = Studio(StudioConfig(seed=10008, cameras=CAMERAS, frames=4, size_px=size))
        frames = [studio.read(at) for at in range(4)]
        for model in ("views", "small"):
            inpainter, made = make_method(model), []
            for frame in frames:
                start = time.process_time()
                shared = SharedTime.of(frame, studio.bounds, HullConfig(), inpainter)
                made.append((1000 * (time.process_time() - start), shared))
                start = time.process_time()
                observe(frame, studio.bounds, HullConfig())
                hull_ms = 1000 * (time.process_time() - start)
            shared = made[-1][1]
            found[f"{size[0]}x{size[1]}, {model}"] = {
                "mb": round(shared.bytes / 1e6, 2),
                "mb_images": round((shared.frame.rgb.numel() + shared.frame.mask.numel()) / 1e6, 2),
                "mb_depths": round(sum(d.numel() * 4 for d in shared.depths.values()) / 1e6, 2),
                "cpu_ms": round(statistics.median(ms for ms, _ in made[1:]), 1),
                "cpu_ms_hull": round(hull_ms, 1),
            }
    return found


class Still(FrameSupply):
    """Frames that are all there."""

    def __init__(self) -> None:
        super().__init__(Span(0, 4, 4, FPS))
        self._studio = Studio(StudioConfig(seed=10008, cameras=CAMERAS, frames=4, size_px=SIZES[1]))
        self.status, self.rig = SourceStatus("ready"), Rig("still", self._studio.bounds, self._studio.up)

    def read(self, time: int):
        return self._studio.read(time)


class Asked:
    """An ingest as an actor, which tells its processor time."""

    def __init__(self) -> None:
        import ray

        self._ingest = Ingest(Still(), make_method("views"), HullConfig(), 500.0, lambda shared: [ray.put(shared)])

    def state(self, known: int, wait_s: float):
        return self._ingest.state(known, wait_s, False)

    def time(self, at: int, wait_s: float):
        return self._ingest.time(at, wait_s)

    def cpu_s(self) -> float:
        return time.process_time()


def ingest_calls(ray) -> dict[str, float]:
    """What a question and a fetch cost, the ingest and the one who asks."""
    actor = ray.remote(num_cpus=1, max_concurrency=32)(Asked).remote()
    _, (reference,) = ray.get(actor.time.remote(0, 60.0))
    ray.get([actor.state.remote(-1, 0.0) for _ in range(200)])
    figures = {}
    for name, ask in {"state": lambda: actor.state.remote(-1, 0.0), "time": lambda: actor.time.remote(0, 1.0)}.items():
        cpu_s, start = ray.get(actor.cpu_s.remote()), time.perf_counter()
        ray.get([ask() for _ in range(CALLS)])
        figures[f"{name}_calls_per_s"] = round(CALLS / (time.perf_counter() - start))
        figures[f"{name}_ingest_cpu_ms"] = round(1000 * (ray.get(actor.cpu_s.remote()) - cpu_s) / CALLS, 3)
    start = time.process_time()
    shared = [ray.get(reference) for _ in range(100)]
    figures["read_cpu_ms"] = round(10 * (time.process_time() - start), 3)
    figures["read_mb"] = round(shared[-1].bytes / 1e6, 2)
    places = {one.frame.rgb.data_ptr() for one in shared}
    assert len(places) == 1, "one place in memory for all who read it"
    ray.kill(actor)
    return figures


def proxy_messages(ray) -> dict[str, float]:
    """What a picture and its ack cost Serve's proxy and the replica; a bare application, four viewers."""
    from ray import serve
    from starlette.applications import Starlette
    from starlette.routing import WebSocketRoute

    def build() -> Starlette:
        async def answer(socket) -> None:
            await socket.accept()
            while True:
                await socket.send_bytes(bytes(int(await socket.receive_text())))

        return Starlette(routes=[WebSocketRoute("/ws", answer)])

    class Bare:
        pass

    quiet = {"enable_access_log": False, "log_level": "ERROR"}
    serve.start(http_options={"host": "127.0.0.1", "port": 8765}, logging_config=quiet)
    serve.run(serve.deployment(max_ongoing_requests=50)(serve.ingress(build)(Bare)).bind(), logging_config=quiet)
    asyncio.run(exchange(100))
    before, start = cpu_s(), time.perf_counter()
    asyncio.run(exchange(MESSAGES))
    count, seconds, after = MESSAGES * CLIENTS, time.perf_counter() - start, cpu_s()
    return {"messages_per_s": round(count / seconds)} | {
        f"{name}_cpu_ms": round(1000 * (after[name] - before[name]) / count, 3) for name in before
    }


async def exchange(messages: int) -> None:
    from websockets.asyncio.client import connect as connected

    async def one() -> None:
        async with connected("ws://127.0.0.1:8765/ws", compression=None, max_size=None) as socket:
            for _ in range(messages):
                await socket.send(str(PICTURE_BYTES))
                await socket.recv()

    await asyncio.gather(*(one() for _ in range(CLIENTS)))


def cpu_s() -> dict[str, float]:
    """Processor seconds of the proxy and the replica so far."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        title = (folder / "cmdline").read_text() if folder.exists() else ""
        for name, start in {"proxy": "ray::ProxyActor", "replica": "ray::ServeReplica"}.items():
            if title.startswith(start):
                fields = (folder / "stat").read_text().rpartition(")")[2].split()
                found[name] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return found


def bill(time_mb: float, cpu_ms: float, calls: dict[str, float], proxy: dict[str, float]) -> dict[str, float]:
    """What a hundred replicas ask of each part, at 15 times a second, eight viewers each."""
    pictures = REPLICAS * VIEWERS * FPS
    asked_cpu_ms = calls["state_ingest_cpu_ms"] + calls["time_ingest_cpu_ms"]
    return {
        "ingest_ms_of_67": round(cpu_ms, 1),
        "ingest_cores_for_questions": round(REPLICAS * FPS * asked_cpu_ms / 1000, 2),
        "store_mb_per_s_a_machine": round(time_mb * FPS, 1),
        "gbit_per_s_into_a_machine": round(8 * time_mb * FPS / 1000, 2),
        "gbit_per_s_out_of_the_ingest": round(8 * time_mb * FPS * (MACHINES - 1) / 1000, 2),
        "pictures_per_s": pictures,
        "proxy_cores_one_proxy": round(pictures * proxy["proxy_cpu_ms"] / 1000, 1),
        "proxy_cores_a_machine": round(pictures / MACHINES * proxy["proxy_cpu_ms"] / 1000, 2),
        "viewers_one_proxy_core": round(1000 / proxy["proxy_cpu_ms"] / FPS),
        "gbit_per_s_to_viewers": round(8 * pictures * PICTURE_BYTES / 1e9, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="write the file in benchmarks/results")
    options = parser.parse_args()
    times = shared_times()
    print(json.dumps(times, indent=1), flush=True)
    ray = find_ray(LOCAL)
    connect(ray, LOCAL, num_cpus=4, object_store_memory=512 * 2**20)
    calls = ingest_calls(ray)
    print(json.dumps(calls, indent=1), flush=True)
    proxy = proxy_messages(ray)
    print(json.dumps(proxy, indent=1), flush=True)
    ray.shutdown()
    paper = {name: bill(own["mb"], own["cpu_ms"], calls, proxy) for name, own in times.items()}
    print(json.dumps(paper, indent=1))
    if options.write:
        config = {"cameras": CAMERAS, "fps": FPS, "replicas": REPLICAS, "machines": MACHINES, "viewers": VIEWERS}
        figures = {"shared times": times, "ingest": calls, "proxy": proxy, "a hundred replicas": paper}
        print(write("many_viewers_paper", "cpu", config | {"picture_bytes": PICTURE_BYTES}, figures))


if __name__ == "__main__":
    main()
